# make demo | test | lint | bench | man. The first call makes the virtual environment.
PYTHON ?= python3
VENV ?= .venv
STAMP := $(VENV)/.installed
FACERF := $(VENV)/bin/facerf

.PHONY: demo test lint bench man setup clean
.DEFAULT_GOAL := demo

$(STAMP): pyproject.toml constraints.txt
	test -x $(VENV)/bin/python || $(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

setup: $(STAMP)

demo: $(STAMP)
	$(FACERF) relight examples/astronaut.jpg --envmap examples/maps/*.exr -o out/demo --ball

lint: $(STAMP)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy

test: lint
	OMP_NUM_THREADS=1 OMP_WAIT_POLICY=PASSIVE $(VENV)/bin/python -m pytest -n 2 --dist loadfile

# Those that want a bank, a dataset, a run or a command, and what scripts share.
NOT_ALONE := ablations align_motion baselines capture_checks capture_copy capture_faults closed_loop \
	diffuse_sh geometry_network loss_curve model_card planted_faults resume synth_stage synthetic \
	training_speed workers yale_table
ALONE = $(filter-out $(NOT_ALONE:%=benchmarks/%.py), $(wildcard benchmarks/*.py))

bench: $(STAMP)
	set -e; for script in $(ALONE); do echo "== $$script"; $(VENV)/bin/python $$script; done

man: $(STAMP)
	$(VENV)/bin/python -m facerf_cli.manpages man

clean:
	rm -rf out build *.egg-info .mypy_cache .ruff_cache .pytest_cache
