from asysplat.errors import InputError, input_error_behind


def test_the_sentence_behind_other_errors_is_found():
    mistake, outer = InputError("scene.json is empty: write it again."), RuntimeError("y")
    outer.__cause__ = KeyError("x")
    assert input_error_behind(outer) is None
    outer.__cause__.__cause__ = mistake
    assert str(input_error_behind(outer)) == str(mistake)


def test_a_worker_s_traceback_is_left_out():
    """As torch's loader raises what a worker process raised."""
    told = (
        "Caught InputError in DataLoader worker process 0.\nOriginal Traceback:\n  File x, line 1\n"
        "asysplat.errors.InputError: a.png is empty (0 bytes): copy it again, or leave it out."
    )
    sentence = str(input_error_behind(InputError(told)))
    assert sentence == "a.png is empty (0 bytes): copy it again, or leave it out."
