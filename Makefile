# What this needs: Python 3.10 to 3.14 with venv and headers, a C++ compiler, make. No ROS 2.
PYTHON ?= python3
BIN := .venv/bin
ARGS ?=

# An ordinary ROS 2 that is active in this shell must not leak into .venv, which has its own.
unexport PYTHONPATH LD_LIBRARY_PATH AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH

.PHONY: help setup run reproduce test lint bench soak clean

help: ## list the targets
	@sed -n 's/^\([a-z]*\):.*## \(.*\)/make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 16

setup: ## set up .venv: ROS 2 wheels, messages, this package (first time one to two minutes)
	@PYTHON='$(PYTHON)' tools/setup

run: setup ## walk, mesh, compute the MFPT over ROS 2, record it; ARGS='--help' lists the options
	@$(BIN)/biped-mfpt run $(ARGS)

reproduce: setup ## the tables and figures of the paper (2 min); ARGS='--quick' takes half a minute
	@$(BIN)/biped-mfpt reproduce $(ARGS)

test: setup ## run the tests but the slow ones; ARGS='-m slow' runs those
	@$(BIN)/python -m pytest -q -m 'not slow' $(ARGS)

lint: setup ## check style and types
	@$(BIN)/ruff check .
	@$(BIN)/mypy

bench: setup ## time step map, mesh and chain; ARGS='--short' or ARGS='--json'
	@$(BIN)/python -m biped_mfpt_ros.bench $(ARGS)

soak: setup ## break things many times and count what came of it; ARGS='--short', '--only fuzz' or '--json'
	@$(BIN)/python -m biped_mfpt_ros.soak $(ARGS)

clean: ## remove .venv and all that was built or cached here; results in runs/ stay
	rm -rf .venv build .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
