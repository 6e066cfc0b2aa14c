# `make demo` and `make test` need nothing but Python, git and make: they build their environment in .venv themselves.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# Each test process computes on one thread; two of them run side by side.
ONE_THREAD := OMP_NUM_THREADS=1

.PHONY: demo test lint clean

demo: $(VENV)/installed
	$(BIN)/python examples/demo.py

test: $(VENV)/tools
	$(ONE_THREAD) $(BIN)/python -m pytest -n 2

lint: $(VENV)/tools
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

$(VENV)/installed: setup.py constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade -c constraints.txt pip setuptools
	$(BIN)/python -m pip install --quiet -c constraints.txt -e .
	touch $@

$(VENV)/tools: $(VENV)/installed
	$(BIN)/python -m pip install --quiet -c constraints.txt -e ".[test]"
	touch $@

clean:
	rm -rf $(VENV) build *.egg-info .pytest_cache .mypy_cache .ruff_cache
