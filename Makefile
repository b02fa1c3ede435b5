# Everything runs in .venv, which the first command builds.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
TRAINS := .venv/.trains
ARGS ?=

.PHONY: train paper test test-slow docs lint check format architecture upgrade clean

train: $(TRAINS)  ## Show the gain: discover an option, move the goal, train with it and without; ARGS="key"
	$(BIN)/python train.py demo $(ARGS)

paper: $(READY)  ## The paper's gridworld figures, 30 runs each, into out/paper
	$(BIN)/python -m experiments.paper all --runs 30 --out out/paper $(ARGS)

test: $(READY)  ## The fast tests
	$(BIN)/python -m pytest -n 2 --dist loadfile -m "not slow" $(ARGS)

test-slow: $(READY)  ## Those that train or simulate for minutes
	$(BIN)/python -m pytest -n 2 --dist loadgroup -m slow $(ARGS)

docs: $(READY)  ## The site, with the API reference and the notebooks run anew, into out/docs/html
	$(BIN)/python -m sphinx --fresh-env --fail-on-warning --keep-going -b html --conf-dir docs . out/docs/html $(ARGS)

lint: $(READY)  ## Style, types, and which folder may import which
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-logo --no-cache
	$(BIN)/mypy

check: lint test  ## What pre-commit runs; CI runs `test-slow` too

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

architecture: $(READY)  ## The folders and their imports, drawn into docs/images
	$(BIN)/python -m docs.architecture

$(READY): pyproject.toml constraints.txt
	test -d .venv || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt --editable '.[dev]'
	touch $(READY)

$(TRAINS): pyproject.toml constraints.txt
	test -d .venv || $(PYTHON) -m venv .venv
	{ test $(READY) -nt pyproject.toml && test $(READY) -nt constraints.txt; } || \
		$(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt --editable '.[train,contrib]'
	touch $(TRAINS)

upgrade:  ## Newest versions that pyproject.toml allows, into constraints.txt
	rm -rf .venv && $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	(head -n 1 constraints.txt; $(BIN)/python -m pip freeze --exclude-editable | sed 's/+cpu//') > constraints.new
	mv constraints.new constraints.txt && touch $(READY)

clean:
	rm -rf .venv build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache
