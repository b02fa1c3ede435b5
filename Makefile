# Everything runs in .venv, which the first command builds.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
ARGS ?=

# rl-zoo3's requirements do not go together with those of constraints.txt.
ZOO := .venv-zoo

.PHONY: train paper test test-zoo lint check format upgrade clean

train: $(READY)  ## Train DQN on the two-room gridworld; pass flags as ARGS="--seed 1"
	$(BIN)/python train.py $(ARGS)

paper: $(READY)  ## The paper's gridworld figures, 30 runs each, into out/paper
	$(BIN)/python -m experiments.paper all --runs 30 --out out/paper $(ARGS)

test: $(READY)  ## All tests
	$(BIN)/python -m pytest -n 2 --dist loadscope $(ARGS)

test-zoo: $(ZOO)/.ready  ## The tests that need rl-zoo3, in an environment of their own
	$(ZOO)/bin/python -m pytest tests/test_rl_zoo3.py tests/test_zoo.py $(ARGS)

lint: $(READY)  ## Style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

check: lint test  ## What CI and pre-commit run

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(READY): pyproject.toml constraints.txt
	test -d .venv || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $(READY)

$(ZOO)/.ready: pyproject.toml constraints-zoo.txt
	test -d $(ZOO) || $(PYTHON) -m venv $(ZOO)
	$(ZOO)/bin/python -m pip install --quiet --constraint constraints-zoo.txt --editable '.[dev,zoo]'
	touch $@

upgrade:  ## Newest versions that pyproject.toml allows, into constraints.txt
	rm -rf .venv && $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	(head -n 1 constraints.txt; $(BIN)/python -m pip freeze --exclude-editable | sed 's/+cpu//') > constraints.new
	mv constraints.new constraints.txt && touch $(READY)
	rm -rf $(ZOO) && $(PYTHON) -m venv $(ZOO)
	$(ZOO)/bin/python -m pip install --quiet --editable '.[dev,zoo]'
	(head -n 1 constraints-zoo.txt; $(ZOO)/bin/python -m pip freeze --exclude-editable | sed 's/+cpu//') > constraints.new
	mv constraints.new constraints-zoo.txt && touch $(ZOO)/.ready

clean:
	rm -rf .venv $(ZOO) build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache
