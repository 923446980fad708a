.PHONY: install demo quick test bench slow oldest docs style format
PYTHON ?= python3
ENV := .venv/.ready
# Two worker processes of one thread each; a file's tests share a process, and so their fixtures.
# Bytecode is kept, as each process would compile the tests and the package again.
PYTEST := OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= .venv/bin/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

install: $(ENV) ## install into .venv
	@echo "next: source .venv/bin/activate"

demo: $(ENV) ## train the paper's network at laptop scale on synthetic scenes, test it and draw its renderings
	.venv/bin/python train.py name=demo
	@echo "to run commands of your own: source .venv/bin/activate"

quick: style ## style, and the fast tests
	$(PYTEST) -m "not medium and not slow"

test: style ## style, and all tests except the slow ones
	$(PYTEST)

bench: $(ENV) ## check for slowdowns: ratios within one process, against docs/results/bench.json
	OMP_NUM_THREADS=1 .venv/bin/python benchmark.py suite=bench repeats=11 \
		output=logs/bench compare=docs/results/bench.json

slow: $(ENV) ## tests of an hour or two: long runs on real scenes, two processes for every model
	$(PYTEST) -m slow

oldest: ## the fast tests with the oldest packages that pyproject.toml allows: needs uv, and downloads them
	uv venv --quiet --clear --python 3.11 logs/oldest
	uv pip install --quiet --python logs/oldest --resolution lowest-direct -e ".[dev]"
	OMP_NUM_THREADS=1 logs/oldest/bin/python -m pytest -n 2 --dist loadfile -m "not medium and not slow"

docs: $(ENV) ## the pages of docs/ and the API, searchable, in logs/docs
	NO_MKDOCS_2_WARNING=1 .venv/bin/mkdocs build --strict
	@echo "page: logs/docs/index.html"

style: $(ENV)
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/ty check --output-format concise

format: $(ENV)
	.venv/bin/ruff check --fix .
	.venv/bin/ruff format .

$(ENV): pyproject.toml
	$(PYTHON) -m venv .venv
	.venv/bin/python -m pip install --quiet --disable-pip-version-check -e ".[dev]"
	touch $(ENV)
