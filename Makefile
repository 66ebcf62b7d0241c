# `make` lists the targets. Needs GNU make 4.3, Rust, Python 3.11 with venv, and Linux.

MAKEFLAGS += --no-builtin-rules --no-print-directory
SHELL := bash
.SHELLFLAGS := -eu -o pipefail -c
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help
# One cargo at a time: a second would only wait for the lock of the first.
.NOTPARALLEL:

CARGO  ?= cargo
PYTHON ?= python3
TARGET := $(or $(CARGO_TARGET_DIR),target)
# Tests and demo share the dev profile, so that the dependencies are built once.
BIN    := $(TARGET)/debug
# FEATURES='--features mpi' builds and tests with training by several processes; what is built keeps its features.
FEATURES ?=

.PHONY: help
help: ## list the targets
	@echo "make TARGET, where TARGET is one of"
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  %-12s %s\n", $$1, $$2 }' Makefile

.PHONY: build
build: ## build the executables (dev profile)
	$(CARGO) build --locked --bins $(FEATURES)

.PHONY: demo
demo: build setup ## from tests/data to tables, a library, trained networks, a plot and answers (build/demo)
	@$(MAKE) --file pipelines/demo.mk BIN=$(BIN)

.PHONY: demo-group
demo-group: build setup ## from tests/data to a library of groups, a model of groups, and five dancers on a page (build/demo-group)
	@$(MAKE) --file pipelines/group.mk BIN=$(BIN)

.PHONY: demo-tokens
demo-tokens: build setup ## from tests/data to a tokenizer, a planner of its tokens, and motion along a path on a page (build/demo-tokens)
	@$(MAKE) --file pipelines/tokens.mk BIN=$(BIN)

# Processors round transforms differently, and a phrase that library constructs is named by a digest of every bit. One row
# of motion that moves by half of its column's spread is told.
TABLES := phrases,motion,beats,features,extractions
DIFF_TABLES = $(BIN)/examples/diff-tables --tables $(TABLES)
.PHONY: build-diff-tables
build-diff-tables:
	$(CARGO) build --locked --example diff-tables $(FEATURES)
.PHONY: check-tables
check-tables: build-diff-tables ## compare the demo's tables with what is kept of them (pipelines/demo.tables.json)
	$(DIFF_TABLES) pipelines/demo.tables.json build/demo/store --tolerance features=1e-4 --tolerance motion=1e-3 \
	  --tolerance phrases.content_hash=inf
.PHONY: keep-tables
keep-tables: build-diff-tables ## keep the demo's tables as they are now; CHANGELOG says why they changed
	$(DIFF_TABLES) --digest build/demo/store > pipelines/demo.tables.json

.PHONY: pretrained
pretrained: build setup ## train the model that ships with the program again (models/pretrained)
	@$(MAKE) --file pipelines/pretrained.mk BIN=$(BIN)

.PHONY: pretrained-group
pretrained-group: build setup ## train the model of groups that ships with the program again (models/group)
	@$(MAKE) --file pipelines/pretrained.mk pretrained-group BIN=$(BIN)

.PHONY: ingest
ingest: build ## ingest your own files: make ingest SOURCE=… STORE=… [SHARDS=8 -j4]
	@$(MAKE) --file pipelines/ingest.mk BIN=$(BIN)

.PHONY: cluster
cluster: ## submit all stages to Slurm as a chain: make cluster SOURCE=… STORE=… RUN=… [SHARDS=16 AGAIN=1 DRY_RUN=1] (docs/cluster.md)
	@MOTIONGEN="$${MOTIONGEN:-$(BIN)/motiongen}" pipelines/slurm/submit.sh

DEMO_ARGS ?=
.PHONY: cluster-demo
cluster-demo: build build-diff-tables ## start a Slurm of two nodes here, kill one under ingest, extract and generate, and compare the tables [DEMO_ARGS]
	@$(PYTHON) pipelines/slurm/demo.py --bin $(BIN) $(DEMO_ARGS)

# With the features of every other build beside `mpi`, so that the dependencies are there already.
.PHONY: mpi-demo
mpi-demo: ## train by two processes of mpirun, of which one is killed, and compare the bits with those of one process [DEMO_ARGS]
	$(CARGO) build --locked --features mpi --bin motiongen
	@$(PYTHON) pipelines/mpi/demo.py --bin $(BIN) $(DEMO_ARGS)

.PHONY: check-kubernetes
check-kubernetes: build/kubernetes-venv/ready ## hold the manifests of pipelines/kubernetes against the API's schema
	@build/kubernetes-venv/bin/python pipelines/kubernetes/check.py

.PHONY: train
train: build ## train and fine-tune: make train STORE=… RUN=… [TRAIN='--preset base --epochs 100']
	@$(MAKE) --file pipelines/train.mk BIN=$(BIN)

.PHONY: test
test: check-format check-data lint build check-code doc ## everything that a change must pass

.PHONY: check-format
check-format:
	$(CARGO) fmt --check

.PHONY: check-data
check-data:
	$(PYTHON) tests/data/make.py --check

.PHONY: setup
setup: ## obtain onnxruntime, with its checksum (.runtime)
	@$(PYTHON) pipelines/onnxruntime/fetch.py

# Unit tests of the library and the executables, the integration tests, and the examples' build.
.PHONY: check-code
check-code: build/venv/ready setup
	MOTIONGEN_TEST_PYTHON='$(CURDIR)/build/venv/bin/python' $(CARGO) test --locked $(FEATURES)

.PHONY: lint
lint: check-format ## check formatting and run clippy
	$(CARGO) clippy --locked --all-targets -- -D warnings

# Advisories come from a repository beyond the package registries; everything else needs no network.
DENY_CHECKS  ?= bans licenses sources
DENY_VERSION := 0.20.2
DENY         := build/tools/cargo-deny-$(DENY_VERSION)/bin/cargo-deny
.PHONY: deny
deny: $(DENY) ## check licences, sources and banned crates of all dependencies [DENY_CHECKS=advisories]
	$(DENY) --locked check --hide-inclusion-graph $(DENY_CHECKS)

# Built without optimisation: it runs for a second.
$(DENY):
	$(CARGO) install cargo-deny --version $(DENY_VERSION) --locked --debug --root build/tools/cargo-deny-$(DENY_VERSION)

.PHONY: doc
doc: ## build the library's documentation
	RUSTDOCFLAGS='-D warnings' $(CARGO) doc --locked --no-deps

# The profile of tests and demo, in which all but polars' planner is optimised; release takes an hour of
# CPU to build polars.
BENCH_PROFILE ?= dev
BENCH_ARGS    ?=
BENCH_BIN     := $(TARGET)/$(if $(filter dev,$(BENCH_PROFILE)),debug,$(BENCH_PROFILE))
.PHONY: bench
bench: build/bench-venv/ready ## measure side by side with peers [BENCH_PROFILE=release BENCH_ARGS=--quick]
	$(CARGO) build --locked --profile $(BENCH_PROFILE) --bins --example plain-read
	build/bench-venv/bin/python benches/bench.py --profile $(BENCH_PROFILE) --bin $(BENCH_BIN) $(BENCH_ARGS)

.PHONY: bench-audio
bench-audio: build/bench-venv/ready ## measure the audio features beside librosa [BENCH_PROFILE, BENCH_ARGS]
	$(CARGO) build --locked --profile $(BENCH_PROFILE) --bin motiongen --example audio-blocks
	build/bench-venv/bin/python benches/audio.py --profile $(BENCH_PROFILE) --bin $(BENCH_BIN) $(BENCH_ARGS)
	$(BENCH_BIN)/examples/audio-blocks build/bench-audio/corpus-*/songs/song.mp3

.PHONY: bench-inputs
bench-inputs: build/bench-venv/ready ## read a corpus of audio files as FFmpeg and libsndfile do [BENCH_ARGS=--list]
	$(CARGO) build --locked --release --no-default-features --example audio-decoded
	build/bench-venv/bin/python benches/inputs.py --bin $(TARGET)/release/examples/audio-decoded $(BENCH_ARGS)

# Rows that need hours; `--seeds 0 --only clock` measures some of them.
.PHONY: bench-ablation
bench-ablation: build setup ## train and measure with each choice left out, three seeds [BENCH_ARGS]
	$(PYTHON) benches/ablation.py --bin $(BIN)/motiongen $(BENCH_ARGS)

.PHONY: bench-parity
bench-parity: build/bench-venv/ready ## compare the audio features with those of librosa [BENCH_ARGS=--per-clip]
	$(CARGO) build --locked --profile $(BENCH_PROFILE) --bin motiongen
	build/bench-venv/bin/python benches/parity.py --bin $(BENCH_BIN) $(BENCH_ARGS)

# The engine is measured as it is shipped; without `query` a release build takes minutes, not an hour.
.PHONY: bench-engine
bench-engine: build/engine-venv/ready ## measure the engine beside PyTorch and onnxruntime [BENCH_ARGS=--parity]
	$(CARGO) build --locked --release --no-default-features --example engine-bench
	build/engine-venv/bin/python benches/engine.py --profile release \
	  --bin $(TARGET)/release/examples/engine-bench $(BENCH_ARGS)

.PHONY: bench-training
bench-training: build/engine-venv/ready ## measure training and fine-tuning beside PyTorch [BENCH_ARGS=--quick]
	$(CARGO) build --locked --bin motiongen
	$(CARGO) build --locked --release --no-default-features --bin motiongen --example training-bench
	build/engine-venv/bin/python benches/training.py --bin $(TARGET)/release $(BENCH_ARGS)

.PHONY: bench-inference
bench-inference: build/engine-venv/ready setup ## measure inference beside PyTorch and onnxruntime [BENCH_ARGS=--quick]
	$(CARGO) build --locked --release --no-default-features --example inference-bench
	build/engine-venv/bin/python benches/inference.py \
	  --bin $(TARGET)/release/examples/inference-bench $(BENCH_ARGS)

.PHONY: bench-tokens
bench-tokens: build/engine-venv/ready setup ## measure motion by tokens beside PyTorch [BENCH_ARGS='--presets small']
	$(CARGO) build --locked --release --no-default-features --example tokens-bench
	build/engine-venv/bin/python benches/tokens.py \
	  --bin $(TARGET)/release/examples/tokens-bench $(BENCH_ARGS)

.PHONY: bench-generation
bench-generation: build/bench-venv/ready setup ## measure generation, whole songs and in bulk [BENCH_ARGS='--model DIR']
	$(CARGO) build --locked --release --no-default-features --bin motiongen
	build/bench-venv/bin/python benches/generation.py --bin $(TARGET)/release/motiongen $(BENCH_ARGS)

.PHONY: bench-evaluation
bench-evaluation: build/bench-venv/ready build ## measure evaluation of 10,000 motions, with the demo's model [BENCH_ARGS]
	build/bench-venv/bin/python benches/evaluation.py --bin $(BIN)/motiongen $(BENCH_ARGS)

.PHONY: bench-store
bench-store: build/bench-venv/ready ## measure a store of a million phrases, and a year of updates [BENCH_PROFILE, BENCH_ARGS]
	$(CARGO) build --locked --profile $(BENCH_PROFILE) --bin motiongen
	build/bench-venv/bin/python benches/store.py --bin $(BENCH_BIN)/motiongen $(BENCH_ARGS)

.PHONY: bench-scale
bench-scale: build/bench-venv/ready ## measure what planning costs on stores of millions of songs that nobody has [BENCH_ARGS]
	$(CARGO) build --locked --profile $(BENCH_PROFILE) --bin motiongen --example synthetic-store
	build/bench-venv/bin/python benches/scale.py --bin $(BENCH_BIN) $(BENCH_ARGS)

.PHONY: bench-room
bench-room: ## build the room autodiff alone, from nothing
	$(PYTHON) benches/room.py

.PHONY: check-fuzz
check-fuzz: ## check that the fuzz targets compile (needs a C++ compiler)
	cd fuzz && RUSTFLAGS='-A warnings' RUSTC_BOOTSTRAP=1 $(CARGO) check --locked --quiet

FUZZ_SECONDS ?= 60
.PHONY: fuzz
fuzz: ## fuzz the readers of untrusted files, each for a minute [FUZZ_SECONDS=600]
	@command -v cargo-fuzz > /dev/null || \
	  { echo 'make fuzz needs cargo-fuzz; install it with: cargo install cargo-fuzz' >&2; exit 2; }
	for target in $(basename $(notdir $(wildcard fuzz/fuzz_targets/*.rs))); do \
	  mkdir -p fuzz/corpus/$$target; \
	  RUSTC_BOOTSTRAP=1 $(CARGO) fuzz run $$target fuzz/corpus/$$target $$(ls -d fuzz/seeds/$$target 2> /dev/null) -- \
	    -max_total_time=$(FUZZ_SECONDS) -rss_limit_mb=1024; \
	done

.PHONY: clean-demo
clean-demo: ## remove what the demo made
	rm -rf build/demo

# Python environments; made once, and again when their requirements change.
build/venv/ready: tests/requirements.txt
build/bench-venv/ready: benches/requirements.txt
build/engine-venv/ready: benches/requirements-engine.txt
build/kubernetes-venv/ready: pipelines/kubernetes/requirements.txt
build/venv/ready build/bench-venv/ready build/engine-venv/ready build/kubernetes-venv/ready:
	rm -rf $(@D)
	$(PYTHON) -m venv $(@D)
	$(@D)/bin/pip install --quiet --disable-pip-version-check --requirement $<
	touch $@
