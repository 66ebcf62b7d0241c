# Ingests your own files, in shards that run side by side:
#
#   make ingest SOURCE=~/music STORE=~/tables
#   make -j4 ingest SOURCE=gs://bucket/music STORE=gs://bucket/tables SHARDS=16
#
# SOURCE and STORE are folders or gs://, s3:// and az:// URLs; credentials come from the environment.
# FLAGS are passed on, for example FLAGS='--workers 2 --cache build/cache'. Shards in a power of two
# share no batch.

SOURCE ?=
STORE  ?=
SHARDS ?= 1
OUT    ?= build/ingest
CONFIG ?=
FLAGS  ?=

.DEFAULT_GOAL := ingest
include $(dir $(lastword $(MAKEFILE_LIST)))common.mk

$(if $(and $(SOURCE),$(STORE)),,$(error name both ends: make ingest SOURCE=music STORE=tables [SHARDS=8 -j4]))

$(call watch,source,$(SOURCE),'$(STORE)' '$(FLAGS)')
$(call prune)
SHARD := $(STAMPS)/shard-
DONE  := $(foreach i,$(shell seq 0 $$(($(SHARDS) - 1))),$(SHARD)$(i)-of-$(SHARDS).done)

.PHONY: ingest
ingest:
	$(call unless_done,ingest,all-shards)
	@echo "ask: $(MOTIONGEN) query --store '$(STORE)' \"select count(*) from phrases\""

.PHONY: all-shards
all-shards: $(DONE)

$(DONE): $(SHARD)%-of-$(SHARDS).done: | $(STAMPS)/source.list $(CONFIG) $(PROGRAM) $(MOTIONGEN)
	$(call stage,$(strip $(MOTIONGEN) ingest --source '$(SOURCE)' --store '$(STORE)' \
	  --shard $*/$(SHARDS) $(CONFIG:%=--config %) $(FLAGS)))
