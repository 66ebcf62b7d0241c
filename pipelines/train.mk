# Trains and fine-tunes on the phrases of a store, and draws how it went.
#
#   make train STORE=gs://bucket/tables RUN=night                 a run of 20 minutes
#   make train STORE=… RUN=… TRAIN='--preset base --epochs 100' FINETUNE='--epochs 50'
#
# Killed, it goes on where it stood. Settings come from CONFIG, a TOML file with [train] and [finetune].

STORE    ?=
RUN      ?=
CONFIG   ?=
TRAIN    ?= --preset small --minutes 20
FINETUNE ?= --minutes 10
OUT      ?= build/train/$(RUN)

.DEFAULT_GOAL := train
include $(dir $(lastword $(MAKEFILE_LIST)))common.mk

$(if $(and $(STORE),$(RUN)),,$(error name both: make train STORE=tables RUN=name))

SETTINGS := $(if $(CONFIG),--config $(CONFIG)) --store '$(STORE)' --run '$(RUN)'
PLOT     := $(OUT)/training.png

.PHONY: train
train:
	$(call unless_done,train,$(PLOT))
	@echo "plot  $(PLOT)"

TRAINED := $(STAMPS)/train.done
$(TRAINED): $(CONFIG) $(MOTIONGEN)
	$(call stage,$(MOTIONGEN) train $(SETTINGS) $(TRAIN))
FINETUNED := $(STAMPS)/finetune.done
$(FINETUNED): $(TRAINED)
	$(call stage,$(MOTIONGEN) finetune $(SETTINGS) $(FINETUNE))
$(PLOT): $(FINETUNED)
	$(MOTIONGEN) plot training --store '$(STORE)' --run '$(RUN)' --output $@
