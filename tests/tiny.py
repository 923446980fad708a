"""Options for a run of the tiniest size."""

SIZE = ["width=0.125", "state_size=8"]
NETWORK = [*SIZE, "model.layers=1m1s"]
VIEWS = [
    *("data.height=32", "data.width=32", "data.inputs=3", "data.targets=2", "data.num_workers=0"),
]
SCENES = ["data.num_images=24", "data.window=[12,24]", "data.val_scenes=1", "data.test_scenes=1"]
STEPS = ["steps=4", "validate_every=2", "trainer.log_every_n_steps=1"]
# A Lightning trainer that only trains or tests.
QUIET = {
    "accelerator": "cpu",
    "logger": False,
    "enable_progress_bar": False,
    "enable_model_summary": False,
}
