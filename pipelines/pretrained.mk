# The model that ships with the program (models/pretrained): the demo's library, trained longer, its weights
# rounded to half precision.
#
#   make pretrained                        builds first
#   make pretrained-group                  the model of groups (models/group)
#   make -f pipelines/pretrained.mk BIN=…  with executables that are there already

DATA    ?= tests/data
OUT     ?= build/pretrained
STORE   ?= $(OUT)/store
CONFIG  ?= pipelines/demo.toml
RUN     := pretrained
LICENCE := MIT OR Apache-2.0; learned from the music and captures listed in LICENSES.md
# A model is chosen on its validation songs, so that more steps than it needs do no harm.
TRAIN   := --steps 6000 --decoder-steps 2000
INTO    ?= models/pretrained

.DEFAULT_GOAL := pretrained
include $(dir $(lastword $(MAKEFILE_LIST)))common.mk

.PHONY: pretrained
pretrained:
	@mkdir -p $(STAMPS)
	for source in phrases music; do \
	  $(MOTIONGEN) ingest --config $(CONFIG) --source $(DATA)/$$source --store $(STORE); done
	$(MOTIONGEN) extract --config $(CONFIG) --store $(STORE)
	$(MOTIONGEN) library --config $(CONFIG) --store $(STORE)
	$(MOTIONGEN) train --config $(CONFIG) --store $(STORE) --run $(RUN) $(TRAIN)
	$(MOTIONGEN) export --store $(STORE) --run $(RUN) --model $(RUN) --weights train \
	  --precision fp16 --licence '$(LICENCE)' --force
	$(MOTIONGEN) generate --store $(STORE) --model $(RUN) --samples 8 --overlap 30
	$(MOTIONGEN) evaluate --store $(STORE) --run $(RUN) --report $(OUT)/report.html
	mkdir -p $(INTO)
	folder=$(STORE)/models/$(RUN); version=$$(sed -n "s/.*\"folder\": *\"\([0-9a-f]*\)\".*/\1/p" $$folder/current.json 2> /dev/null || true); \
	  cp $$folder/$$version/unet.onnx $$folder/$$version/decoder.onnx $$folder/$$version/model.json $(INTO)/
	@echo "model   $(INTO)"
	@echo "report  $(OUT)/report.html"

# The model of groups: songs of tests/data and composed ones, groups of two to five.
GROUP_STORE  ?= $(OUT)/group-store
GROUP_CONFIG ?= pipelines/group.toml
GROUP_TRAIN  ?= --preset tiny --steps 1200
GROUP_INTO   ?= models/group
GROUP        := group

.PHONY: pretrained-group
pretrained-group:
	@mkdir -p $(STAMPS)
	for source in phrases music; do \
	  $(MOTIONGEN) ingest --config $(GROUP_CONFIG) --source $(DATA)/$$source --store $(GROUP_STORE); done
	$(MOTIONGEN) extract --config $(GROUP_CONFIG) --store $(GROUP_STORE)
	# 1 is no obstacle: a song that is shorter than a phrase was listed.
	$(MOTIONGEN) library --config $(GROUP_CONFIG) --store $(GROUP_STORE) --dancers 2..5 || [ $$? -eq 1 ]
	$(MOTIONGEN) train --config $(GROUP_CONFIG) --store $(GROUP_STORE) --family group --run $(GROUP) $(GROUP_TRAIN)
	$(MOTIONGEN) export --store $(GROUP_STORE) --run $(GROUP) --model $(GROUP) --precision fp16 --licence '$(LICENCE)' --force
	for gamma in -1 0 1; do \
	  $(MOTIONGEN) generate --config $(GROUP_CONFIG) --store $(GROUP_STORE) --model $(GROUP) --dancers 4 --split test \
	    --consistency $$gamma --run gamma$$gamma; \
	  $(MOTIONGEN) evaluate --store $(GROUP_STORE) --run gamma$$gamma --report $(OUT)/group-report.html; done
	mkdir -p $(GROUP_INTO)
	folder=$(GROUP_STORE)/models/$(GROUP); \
	  version=$$(sed -n "s/.*\"folder\": *\"\([0-9a-f]*\)\".*/\1/p" $$folder/current.json 2> /dev/null || true); \
	  cp $$folder/$$version/denoiser.onnx $$folder/$$version/score.onnx $$folder/$$version/model.json $(GROUP_INTO)/
	@echo "model   $(GROUP_INTO)"
	@echo "report  $(OUT)/group-report.html"
