.PHONY: demo test slow format
PYTHON ?= python3
ENV := .venv/.ready

demo: $(ENV) ## train a small model on synthetic scenes, measure it, draw what it sees
	.venv/bin/python train.py name=demo
	@echo "to go on with commands of your own: source .venv/bin/activate"

test: $(ENV) ## style and tests
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	OMP_NUM_THREADS=1 .venv/bin/python -m pytest -n 2 # two tests at a time, a thread each

slow: $(ENV) ## what takes an hour or two: long runs on real scenes, two processes for every model
	OMP_NUM_THREADS=1 .venv/bin/python -m pytest -n 2 -m slow

format: $(ENV)
	.venv/bin/ruff check --fix .
	.venv/bin/ruff format .

$(ENV): pyproject.toml
	$(PYTHON) -m venv .venv
	.venv/bin/python -m pip install --quiet --disable-pip-version-check -e ".[dev]"
	touch $(ENV)
