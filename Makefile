# `make repair`, `make test` and `make wheel-test` set up everything they need.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/ready
INSTALL := $(BIN)/python -m pip install --disable-pip-version-check --constraint constraints.txt --no-compile

# Packages come without compiled modules, most of which nothing imports. What is imported is kept compiled, also where the
# environment forbids that: else each process would compile it again, for ten seconds.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: repair test wheel-test judge check docs bench format clean

repair: $(VENV)/repair
	$(BIN)/rejoint repair emulated:worn

# Tests by the wall clock mostly wait: four at a time. They fail too where the machine itself stalls, and are tried
# again, which is printed.
test: $(READY)
	$(BIN)/python -m pytest -n 3 --dist loadfile -m "not realtime"
	$(BIN)/python -m pytest -n 4 --dist loadfile -m realtime --reruns 2 -rR $$(grep -rlw --include="test_*.py" realtime tests)

# The wheel in a fresh environment without extras: it deploys, and names the extra that other commands need.
wheel-test: $(READY)
	$(BIN)/python -m pytest wheeltest

# LeRobot's own buses judge the emulated ones, its base classes our robot of theirs, and NVIDIA's reader of LEAPP the
# controllers that leave a run, in a folder of their own: their other dependencies are none of ours.
judge: $(READY)
	$(BIN)/python -m pip install --quiet --no-deps --upgrade --target .judge lerobot==0.4.4 feetech-servo-sdk==1.0.0 dynamixel-sdk==4.1.0 \
		draccus==0.10.0 deepdiff orderly-set cachebox tqdm pyserial numpy pyyaml 'pyyaml-include<2' mergedeep typing-inspect mypy-extensions typing-extensions \
		leapp==0.7.2 onnxscript onnx_ir fast-sugiyama safetensors
	$(BIN)/python -m pytest tests/robots/test_lerobot_judge.py tests/robots/test_lerobot_robot.py tests/runs/test_exporting.py

check: $(READY)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# The site, in site/. A broken link or a warning is an error; the theme's notice about its successor is none.
docs: $(VENV)/docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

bench: $(VENV)/bench
	$(if $(LOGS),REJOINT_SO101="$(LOGS)") $(BIN)/python -m benchmarks

format: $(READY)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

# A half-made environment has no file of its name and is made again. What a repair needs and no more:
$(VENV)/repair: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; v = sys.version_info; v >= (3, 11) or sys.exit("rejoint needs Python 3.11 or newer, and $(PYTHON) is %d.%d; install one, then: make repair PYTHON=python3.11" % v[:2])'
	@echo "Installing what a repair needs into $(VENV): 1.75 GB, in a minute or two with a fast connection."
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) --editable ".[repair]"
	@touch $@

# What the tests and checks need too.
$(READY): $(VENV)/repair
	$(INSTALL) --quiet --editable ".[dev]"
	@touch $@

# What builds the site; nothing else needs it.
$(VENV)/docs: $(READY)
	$(INSTALL) --quiet --editable ".[docs]"
	@touch $@

# The other programs that the benchmarks compare with; nothing else needs them.
$(VENV)/bench: $(READY)
	$(INSTALL) --quiet --editable ".[bench]"
	@touch $@

clean:
	rm -rf $(VENV) .judge build dist site
