# Everything runs in .venv, made from the project's own files.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: study test test-slow bench docs figures lint clean

$(BIN)/workbench: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[test]'
	touch $@

study: $(BIN)/workbench  ## the main job: a beam from measured response to controlled structure
	$(BIN)/workbench study beam

test: $(BIN)/workbench  ## the default test run; it says what it skips and why
	$(BIN)/python -m pytest -q -rs -n auto --dist worksteal

test-slow: $(BIN)/workbench  ## the longer trials
	$(BIN)/python -m pytest -q -m slow

figures: $(BIN)/workbench  ## every study that makes its own data, with its figures and results: hours
	$(BIN)/workbench study --all

bench: $(BIN)/workbench  ## speeds, as ratios, in a quarter of an hour; the bench to play on is `workbench bench`
	$(BIN)/workbench study design_scaling
	$(BIN)/workbench study many_cases
	$(BIN)/workbench study diagnosis_speed

docs: $(BIN)/workbench  ## the site, out/docs/index.html; a broken link or reference is an error
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[docs]'
	$(BIN)/python -m sphinx -q -W --keep-going -b html docs out/docs
	@echo "open out/docs/index.html"

lint: $(BIN)/workbench  ## style and types
	$(BIN)/ruff check workbench studies tests
	$(BIN)/mypy

clean:
	rm -rf $(VENV) out
