# Two commands for a new user, `make demo` and `make test`; each makes .venv by itself, once.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.wearcap-installed

.DEFAULT_GOAL := help
.PHONY: help install demo test test-real lint format lock registry release addon site site-serve clean

help:
	@echo "make demo       prepare simulated data, train, evaluate, capture, export (about 2 minutes on 2 quiet cores)"
	@echo "make test       ruff, basedpyright, and every test that needs no GPU and no real recordings"
	@echo "make test-real  the tests on real recordings (../shared/data, or WEARCAP_REAL_DATA)"
	@echo "make format     let ruff mend what it can"
	@echo "make lock       write requirements.lock from a clean environment"
	@echo "make registry   checkpoints/registry.json from the files beside it"
	@echo "make release    check, build and try a release, and print the commands that publish it"
	@echo "make addon      dist/wearcap_blender.zip, the Blender add-on"
	@echo "make site       build/site, the documentation with its notebooks executed; make site-serve shows it while it is written"
	@echo "make clean      remove $(VENV)"
	@echo "PYTHON=python3.12 make demo  takes another interpreter (3.11 to 3.13)"

install: $(STAMP)

$(STAMP): pyproject.toml requirements.lock
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] not in ((3, 11), (3, 12), (3, 13)))' || { \
	  echo "wearcap needs Python 3.11 to 3.13, but '$(PYTHON)' is $$($(PYTHON) --version 2>&1). Try: make PYTHON=python3.12 $(MAKECMDGOALS)" >&2; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) || { \
	  echo "Python's venv is missing (Debian: apt install python3-venv)." >&2; rm -rf $(VENV); exit 1; }
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c requirements.lock -e '.[dev]'
	@touch $@

demo: $(STAMP)
	$(BIN)/wearcap demo

# Bytecode of the tests and of the checked modules is kept, also where the environment says otherwise: half of a start.
test: lint
	PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m "not real and not gpu" -n 2 --dist loadfile

test-real: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m "real and not gpu" -n 2 --dist loadfile

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/basedpyright

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

lock:
	rm -rf $(VENV)-lock
	$(PYTHON) -m venv $(VENV)-lock
	$(VENV)-lock/bin/python -m pip install --quiet -e '.[dev,site]' torch==2.13.0
	{ sed -n '/^#/p' requirements.lock; $(VENV)-lock/bin/python -m pip freeze --exclude-editable \
	  | grep -v -E '^(nvidia-|triton|cuda-)' | sed 's/+cpu$$//' | sort -f; } > requirements.lock.new
	mv requirements.lock.new requirements.lock
	rm -rf $(VENV)-lock

registry: $(STAMP)
	$(BIN)/python -m release.registry

release: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check 'build>=1.3' 'twine>=6.1'
	$(BIN)/python -m release

addon:
	mkdir -p dist
	$(PYTHON) -m zipfile -c dist/wearcap_blender.zip integrations/blender/wearcap_blender/*.*

site: $(VENV)/.site-installed $(patsubst examples/%,build/%,$(wildcard examples/notebooks/*.ipynb))
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

site-serve: $(VENV)/.site-installed
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs serve

build/notebooks/%.ipynb: examples/notebooks/%.ipynb | $(VENV)/.site-installed
	$(BIN)/python -m nbconvert --to notebook --execute --output-dir $(@D) $<

$(VENV)/.site-installed: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c requirements.lock -e '.[site]'
	@touch $@

clean:
	rm -rf $(VENV)
