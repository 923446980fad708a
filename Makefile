.PHONY: demo quick test bench slow style format
PYTHON ?= python3
ENV := .venv/.ready
# Two tests at a time, a thread each; who is done takes tests of the other.
PYTEST := OMP_NUM_THREADS=1 .venv/bin/python -m pytest -n 2 --dist worksteal

demo: $(ENV) ## train a small model on synthetic scenes, measure it, draw what it sees
	.venv/bin/python train.py name=demo
	@echo "to go on with commands of your own: source .venv/bin/activate"

quick: style ## style, and the tests that take seconds
	$(PYTEST) -m "not medium and not slow"

test: style ## style, and all tests but those of hours
	$(PYTEST)

bench: $(ENV) ## did a change make anything slower: ratios within one process, against docs/results/bench.json
	OMP_NUM_THREADS=1 .venv/bin/python benchmark.py suite=bench repeats=11 \
		output=logs/bench compare=docs/results/bench.json

slow: $(ENV) ## what takes an hour or two: long runs on real scenes, two processes for every model
	$(PYTEST) -m slow

style: $(ENV)
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .

format: $(ENV)
	.venv/bin/ruff check --fix .
	.venv/bin/ruff format .

$(ENV): pyproject.toml
	$(PYTHON) -m venv .venv
	.venv/bin/python -m pip install --quiet --disable-pip-version-check -e ".[dev]"
	touch $(ENV)
