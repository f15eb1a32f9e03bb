# netpos: make setup | demo | test | lint | docs | baselines | bench | clean
SHELL := /bin/bash
.DEFAULT_GOAL := help
SHELL_FILES := env.sh $(wildcard scripts/*.sh) scripts/ros2_standin/ros2 $(wildcard docker/*.sh) .ci/run

.PHONY: help setup demo test test-unit test-integration baselines lint docs bench clean

help: ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 20

setup: ## install everything into .venv and build the workspace (does nothing when up to date)
	@scripts/setup.sh

demo: setup ## run METIS Madrid as a live graph, record, replay, score, draw; then the real BLE run where its data is
	@. ./env.sh && scripts/demo.sh

test: setup lint test-unit test-integration ## everything CI runs

test-unit: setup ## the library and the nodes' conversions, without a running graph
	@. ./env.sh && python -m pytest -q -n auto --dist loadfile ros2_ws/src/netpos/test
	@. ./env.sh && python -m pytest -q ros2_ws/src --ignore=ros2_ws/src/netpos

test-integration: setup ## the real processes, started with ros2 run
	@. ./env.sh && python -m pytest -q tests

lint: setup ## ruff, mypy, shellcheck
	@. ./env.sh && ruff check . && ruff format --check . && mypy && shellcheck -x $(SHELL_FILES)

docs: setup ## the site of the documents into out/site; a warning is an error
	@. ./env.sh && NO_MKDOCS_2_WARNING=1 mkdocs build --strict --quiet && echo "wrote out/site/index.html"

baselines: setup ## rewrite the figures the tests hold scenarios and recordings to; read the diff before committing it
	@. ./env.sh && python scripts/baselines.py

bench: setup ## speed as ratios measured in one run
	@. ./env.sh && netpos bench

clean: ## remove what setup made
	rm -rf .venv ros2_ws/build ros2_ws/install ros2_ws/log out
