# Needs Python 3.11 or newer and make; everything else goes into .venv.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
SAMPLES := sample_data
SAMPLE := $(SAMPLES)/pan

.PHONY: test test-slow test-all lint demo bench paper scenes worlds model plates plate-model mutants \
	regression results scale clean

.venv/program: pyproject.toml  # what a user needs
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "Python 3.11 or newer is needed; set PYTHON=" >&2; exit 1; }
	$(PYTHON) -m venv .venv
	$(BIN)/pip install -q -e .
	@touch $@

.venv/installed: .venv/program  # what tests and studies need as well
	$(BIN)/pip install -q -e '.[dev]'
	@touch $@

# It starts hundreds of processes: compile once. Without a test pytest fails (exit code 5).
PYTEST := PYTHONDONTWRITEBYTECODE= $(BIN)/pytest

test: .venv/installed  # at least one test of everything: under three minutes on two cores
	$(PYTEST) -m 'not slow' --durations=10

test-slow: .venv/installed  # the rest: clusters, stopped runs, learning, long recordings, statistics
	$(PYTEST) -m slow

test-all: .venv/installed
	$(PYTEST)

lint: .venv/installed
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

demo: .venv/program  # the sample log, from images to tables
	$(BIN)/sonarrec run $(SAMPLE) --overwrite --out build/demo
	$(BIN)/sonarrec evaluate --ground-truth $(SAMPLE)/gt.csv build/demo/$(notdir $(SAMPLE))

bench: .venv/installed  # cost per frame and memory, beside PNG decoding and a plain loop
	PYTHONDONTWRITEBYTECODE= $(BIN)/python -m tests.studies.bench --record bench

scale: .venv/installed  # a thousand logs, killed; how cost grows, long logs (over half an hour)
	$(BIN)/python -m tests.studies.scale --record scale

paper: .venv/installed  # Tables 4 and 5 in the worlds on record, beside the published (a quarter of an hour)
	$(BIN)/python -m tests.studies.paper.prediction --record paper

scenes: .venv/installed  # every kind of random scene, all methods, beside the goals
	$(BIN)/python -m tests.studies.scenes --record scenes

worlds: .venv/installed  # recordings that are not ours, where they are at hand
	$(BIN)/python -m tests.studies.worlds --record worlds

model: .venv/installed  # the built-in reader of stage 3, learned from nothing (over an hour)
	$(BIN)/pip install -q -e '.[learn]'
	$(BIN)/python -m tests.studies.learning.built_in

plates: .venv/installed  # sixteen drawings that no model was learned from, on simulated plates
	$(BIN)/python -m tests.studies.plates

plate-model: .venv/installed  # the built-in model of drawn plates, from simulated recordings (minutes)
	$(BIN)/python -m tests.studies.learning.plates

mutants: .venv/installed  # changes the package at random: what no test notices (two hours)
	$(BIN)/python -m tests.support.mutants

results: .venv/installed  # RESULTS.md from the studies' files; marks what is stale
	$(BIN)/python -m tests.studies.results

regression: .venv/installed  # the sample logs against their results on record
	$(BIN)/sonarrec check $(SAMPLES)/sonarrec.check.toml
	$(BIN)/sonarrec check $(SAMPLES)/offline.check.toml

clean:
	rm -rf build .venv
