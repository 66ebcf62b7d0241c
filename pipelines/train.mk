# Trains on the phrases of a store, fine-tunes where that is asked for, and draws how it went.
#
#   make train STORE=gs://bucket/tables RUN=night                 a run of 20 minutes
#   make train STORE=… RUN=… TRAIN='--preset base --epochs 100' FINETUNE='--epochs 50'
#
# Killed, it goes on where it stood. Settings come from CONFIG, a TOML file with [train] and [finetune].

STORE    ?=
RUN      ?=
CONFIG   ?=
TRAIN    ?= --preset small --minutes 20
# Flags of finetune; none, and the run is left as it was trained.
FINETUNE ?=
OUT      ?= build/train/$(RUN)

.DEFAULT_GOAL := train
include $(dir $(lastword $(MAKEFILE_LIST)))common.mk

$(if $(and $(STORE),$(RUN)),,$(error name both: make train STORE=tables RUN=name))

# What was asked for, beside the configuration.
$(call watch,settings,,'$(STORE)' '$(RUN)' '$(TRAIN)' '$(FINETUNE)')
$(call prune)
ASKED := $(STAMPS)/settings.list $(CONFIG) $(PROGRAM) $(MOTIONGEN)

SETTINGS := $(if $(CONFIG),--config $(CONFIG)) --store '$(STORE)' --run '$(RUN)'
PLOT     := $(OUT)/training.png

.PHONY: train
train:
	$(call unless_done,train,$(PLOTTED))
	@echo "plot  $(PLOT)"

TRAINED := $(STAMPS)/train.done
$(TRAINED): | $(ASKED)
	$(call stage,$(MOTIONGEN) train $(SETTINGS) $(TRAIN))
FINETUNED := $(if $(FINETUNE),$(STAMPS)/finetune.done,$(TRAINED))
$(STAMPS)/finetune.done: | $(TRAINED) $(ASKED)
	$(call stage,$(MOTIONGEN) finetune $(SETTINGS) $(FINETUNE))
PLOTTED := $(STAMPS)/plot.done
$(PLOTTED): | $(FINETUNED) $(ASKED)
	$(call stage,$(MOTIONGEN) plot training --store '$(STORE)' --run '$(RUN)' --output $(PLOT),$(PLOT))
