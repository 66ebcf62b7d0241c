# Tokens: songs and captures of tests/data become a library, a small tokenizer learns to write its motion, all of it is
# written as tokens, a planner learns which tokens go with music, and motion is made and evaluated, freely and along a
# path (docs/tokens.md).
#
#   make demo-tokens                        builds first
#   make -f pipelines/tokens.mk BIN=…       with executables that are there already

DATA   ?= tests/data
OUT    ?= build/demo-tokens
STORE  ?= $(OUT)/store
CONFIG ?= pipelines/tokens.toml
TOKENIZER ?= tokenizer
RUN    ?= planner
MODEL  ?= tokens
# What is asked of the motion along a path, and what its run is called.
CONSTRAINTS ?= pipelines/tokens.constraints.toml
PATH_RUN    := path
# The song that is looked at.
SONG   ?= $(firstword $(sort $(wildcard $(DATA)/music/gunroar/*.ogg)))

.DEFAULT_GOAL := demo-tokens
include $(dir $(lastword $(MAKEFILE_LIST)))common.mk
include $(PIPELINES)songs.mk

.PHONY: demo-tokens
demo-tokens:
	$(call unless_done,demo-tokens,$(ANSWERED))
	@echo
	@echo "tables   $(STORE)"
	@echo "answers  $(ANSWERS)"
	@echo "plots    $(PLOTS)"
	@echo "model    $(STORE)/models/$(MODEL)"
	@echo "motion   $(PAGE) (open it in a browser)"
	@echo "report   $(REPORT) (open it in a browser)"

# library: phrases to learn from, constructed from the songs and the captures.
LIBRARY := $(STAMPS)/library.done
$(LIBRARY): | $(EXTRACTED) $(WITH)
	$(call stage,$(MOTIONGEN) library --config $(CONFIG) --store $(STORE))

# train, tokenize and evaluate: a tokenizer, the tokens of the library, and what is left of motion that it never met.
TOKENIZER_TRAINED := $(STAMPS)/train-$(TOKENIZER).done
$(TOKENIZER_TRAINED): | $(LIBRARY) $(WITH)
	$(call stage,$(MOTIONGEN) train --config $(CONFIG) --store $(STORE) --family tokens --run $(TOKENIZER))
TOKENIZED := $(STAMPS)/tokenize-$(TOKENIZER).done
$(TOKENIZED): | $(TOKENIZER_TRAINED) $(WITH)
	$(call stage,$(MOTIONGEN) tokenize --config $(CONFIG) --store $(STORE) --run $(TOKENIZER))
RECONSTRUCTED := $(STAMPS)/evaluate-$(TOKENIZER).done
$(RECONSTRUCTED): | $(TOKENIZER_TRAINED) $(WITH)
	$(call stage,$(MOTIONGEN) evaluate --config $(CONFIG) --store $(STORE) --tokenizer $(TOKENIZER) --num-samples 100 \
	  --baseline-windows 32)

# train and export: a planner of those tokens, and both as a model.
TRAINED := $(STAMPS)/train-$(RUN).done
$(TRAINED): | $(TOKENIZER_TRAINED) $(WITH)
	$(call stage,$(MOTIONGEN) train --config $(CONFIG) --store $(STORE) --family tokens --tokenizer $(TOKENIZER) \
	  --run $(RUN))
EXPORTED := $(STAMPS)/export-$(MODEL).done
$(EXPORTED): | $(TRAINED) $(WITH)
	$(call stage,$(MOTIONGEN) export --config $(CONFIG) --store $(STORE) --run $(RUN) --model $(MODEL) --force)

# plot: how both learned, and how the codes are used.
PLOTS := $(OUT)/training-$(TOKENIZER).png $(OUT)/training-$(RUN).png $(OUT)/codes.png
PLOTTED := $(patsubst %,$(STAMPS)/plot-%.done,$(TOKENIZER) $(RUN) codes)
$(STAMPS)/plot-$(TOKENIZER).done: | $(TOKENIZER_TRAINED) $(WITH)
	$(call stage,$(MOTIONGEN) plot training --store $(STORE) --run $(TOKENIZER) \
	  --output $(word 1,$(PLOTS)),$(word 1,$(PLOTS)))
$(STAMPS)/plot-$(RUN).done: | $(TRAINED) $(WITH)
	$(call stage,$(MOTIONGEN) plot training --store $(STORE) --run $(RUN) --output $(word 2,$(PLOTS)),$(word 2,$(PLOTS)))
$(STAMPS)/plot-codes.done: | $(TOKENIZED) $(WITH)
	$(call stage,$(MOTIONGEN) plot tokens --store $(STORE) --run $(TOKENIZER) --output $(word 3,$(PLOTS)),$(word 3,$(PLOTS)))

# generate and evaluate: motion for every song, freely and along a path, and for one song as a page.
REPORT := $(OUT)/report.html
$(STAMPS)/generate-$(MODEL).done: | $(EXPORTED) $(WITH)
	$(call stage,$(MOTIONGEN) generate --config $(CONFIG) --store $(STORE) --model $(MODEL))
$(STAMPS)/evaluate-$(MODEL).done: | $(STAMPS)/generate-$(MODEL).done $(WITH)
	$(call stage,$(MOTIONGEN) evaluate --config $(CONFIG) --store $(STORE) --run $(MODEL) --baseline-windows 64 \
	  --report $(REPORT),$(REPORT))
$(STAMPS)/generate-$(PATH_RUN).done: | $(EXPORTED) $(CONSTRAINTS) $(WITH)
	$(call stage,$(MOTIONGEN) generate --config $(CONFIG) --store $(STORE) --model $(MODEL) --run $(PATH_RUN) \
	  --constraints $(CONSTRAINTS))
$(STAMPS)/evaluate-$(PATH_RUN).done: | $(STAMPS)/generate-$(PATH_RUN).done $(WITH)
	$(call stage,$(MOTIONGEN) evaluate --config $(CONFIG) --store $(STORE) --run $(PATH_RUN) --baseline-windows 0)
EVALUATED := $(RECONSTRUCTED) $(STAMPS)/evaluate-$(MODEL).done $(STAMPS)/evaluate-$(PATH_RUN).done

PAGE := $(OUT)/motion/$(basename $(notdir $(SONG))).html
SHOWN := $(STAMPS)/page-$(MODEL).done
$(SHOWN): | $(EXPORTED) $(CONSTRAINTS) $(WITH)
	$(call stage,$(MOTIONGEN) generate --config $(CONFIG) --model $(STORE)/models/$(MODEL) --audio $(SONG) \
	  --output $(OUT)/motion --samples 1 --constraints $(CONSTRAINTS) --format npy$(comma)png$(comma)html,$(PAGE))

define CODES
select count(distinct token) as codes_in_use, count(*) as tokens from tokens where run = '\''$(TOKENIZER)'\''
endef
define KEPT
select split, subject, metric, variant, round(value, 4) as value, unit from metrics
where run = '\''$(TOKENIZER)'\'' and (metric like '\''reconstruction%'\'' or metric in
('\''code_perplexity'\'', '\''tokens_per_frame'\'', '\''fid_g'\'') or (metric = '\''fid_k'\'' and variant = '\''axes'\''))
order by metric, variant, split, subject
endef
define ASKED
select split, metric, variant, round(value, 4) as value, unit, n from metrics
where run = '\''$(PATH_RUN)'\'' and metric like '\''control%'\'' order by metric, variant, split
endef
define VERDICTS
select split, verdict, test, outcome, message from verdicts
where run = '\''$(MODEL)'\'' and split = '\''held_out'\'' order by verdict, test
endef

ANSWERED := $(STAMPS)/answers.done
$(ANSWERED): | $(EVALUATED) $(PLOTTED) $(SHOWN) $(WITH)
	@rm -f $(ANSWERS).new
	$(call ask,How many codes are in use,CODES)
	$(call ask,What is left of motion that the tokenizer never met,KEPT)
	$(call ask,Whether motion goes where it was asked to,ASKED)
	$(call ask,What the verdicts are,VERDICTS)
	$(call stage,mv $(ANSWERS).new $(ANSWERS),$(ANSWERS))
