# make demo | lint | test | check | test-slow | docs | man | dist. The first call makes the virtual environment.
PYTHON ?= python3
VENV ?= .venv
STAMP := $(VENV)/.installed
FACERF := $(VENV)/bin/facerf

.PHONY: demo lint test check test-slow docs man dist setup clean
.DEFAULT_GOAL := demo

$(STAMP): pyproject.toml constraints.txt
	test -x $(VENV)/bin/python || $(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

setup: $(STAMP)

demo: out/demo.jpg

out/demo.jpg: | $(STAMP)
	$(FACERF) demo -o $@

lint: $(STAMP)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy

PYTEST := OMP_NUM_THREADS=1 OMP_WAIT_POLICY=PASSIVE $(VENV)/bin/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

test: $(STAMP)
	$(PYTEST) -m "not slow"

check: lint
	$(MAKE) test

test-slow: $(STAMP)
	$(PYTEST) -m slow

# The site, into site/; a dead link or a warning fails.
docs: $(STAMP)
	$(VENV)/bin/python -m tools.pages build/pages
	NO_MKDOCS_2_WARNING=1 $(VENV)/bin/mkdocs build --strict

man: $(STAMP)
	$(VENV)/bin/python -m facerf_cli.cli.manual man

# The source distribution, and the wheel from it, as tests/test_distribution.py builds them.
dist: $(STAMP)
	$(VENV)/bin/python -m build --no-isolation

clean:
	rm -rf out build dist site *.egg-info .mypy_cache .ruff_cache .pytest_cache
