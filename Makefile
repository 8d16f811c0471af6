# `make repair`, `make test` and `make wheel-test` set up everything they need.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/ready

.PHONY: repair test wheel-test judge check docs bench format clean

repair: $(READY)
	$(BIN)/rejoint repair emulated:worn

# Tests by the wall clock mostly wait: four at a time. They fail too where the machine itself stalls, and are tried
# again, which is printed.
test: $(READY)
	$(BIN)/python -m pytest -n 2 --dist loadfile -m "not realtime"
	$(BIN)/python -m pytest -n 4 --dist loadfile -m realtime --reruns 2 -rR

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
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

bench: $(VENV)/bench
	$(if $(LOGS),REJOINT_SO101="$(LOGS)") $(BIN)/python -m benchmarks

format: $(READY)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

# A half-made environment has no `ready` file and is made again.
$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[train,report,logs,camera,feetech,dynamixel,fleet,live,dev]"
	touch $(READY)

# What builds the site; nothing else needs it.
$(VENV)/docs: $(READY)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[docs]"
	touch $(VENV)/docs

# The other programs that the benchmarks compare with; nothing else needs them.
$(VENV)/bench: $(READY)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[bench]"
	touch $(VENV)/bench

clean:
	rm -rf $(VENV) .judge build dist site
