# make demo    install into .venv and run all steps on a generated area
# make test    install and run the tests; `make test EXTRAS=test` without PyTorch and Ray, whose tests
#              are then skipped by name
# make lint    style, types, import layers
# make bench   measure building, and latency, load and accuracy of `orthonav fly`
# make paper   the tables of the paper in the reduced setting, about two hours on two cores
# make docs    the documentation as a site in site/, to be opened without a server
# make figures  renew the figures of the documentation by running a tutorial, minutes
# make golden   renew the golden views of tests/golden; give the reason in the commit
# make clean   remove .venv and what was made here

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := sh tools/install.sh $(BIN)/python
PYTEST := $(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder -rfEs
EXTRAS ?= dev
DEPENDS := pyproject.toml constraints.txt

.PHONY: demo test test-long test-slow lint format bench paper docs figures golden clean

demo: $(VENV)/.run-installed
	$(BIN)/orthonav demo --out demo

test: $(VENV)/.$(EXTRAS)-installed
	$(PYTEST)

# Seconds each.
test-long: $(VENV)/.$(EXTRAS)-installed
	$(PYTEST) -m "long and not slow"

# All, those of minutes too: the limits are longer.
test-slow: $(VENV)/.dev-installed
	$(PYTEST) -m "" -o timeout=1800 -o faulthandler_timeout=1900

lint: $(VENV)/.dev-installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/vulture

format: $(VENV)/.dev-installed
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(VENV)/.dev-installed
	$(BIN)/python -m benchmarks.build
	$(BIN)/python -m benchmarks.onboard

paper: $(VENV)/.dev-installed
	$(BIN)/python -m experiments.paper

docs: $(VENV)/.docs-installed
	$(BIN)/python -m sphinx -W --keep-going -n -q -b html docs site
	@echo "open site/index.html"

figures: $(VENV)/.docs-installed
	PYTHONPATH=. $(BIN)/python tools/docs/pictures.py

golden: $(VENV)/.dev-installed
	PYTHONPATH=. $(BIN)/python tests/golden/renew.py

$(BIN)/python:
	@sh tools/make_venv.sh "$(PYTHON)" "$(VENV)"

$(VENV)/.run-installed: $(DEPENDS) | $(BIN)/python
	$(PIP) geo,report,fetch,web
	@touch $@

$(VENV)/.dev-installed: $(DEPENDS) | $(BIN)/python
	$(PIP) dev
	@touch $@ $(VENV)/.run-installed

$(VENV)/.docs-installed: $(VENV)/.dev-installed
	$(PIP) dev,docs
	@touch $@

# What EXTRAS asks for
$(VENV)/.%-installed: $(DEPENDS) | $(BIN)/python
	$(PIP) $*
	@touch $@

clean:
	rm -rf $(VENV) demo site bench_results paper_results .mypy_cache .ruff_cache .pytest_cache .hypothesis
