# Groups: songs and captures of tests/data become a library of groups, a small model of groups learns from it, and five
# dancers are made for songs that it never met, at three degrees of consistency (docs/groups.md).
#
#   make demo-group                        builds first
#   make -f pipelines/group.mk BIN=…       with executables that are there already

DATA   ?= tests/data
OUT    ?= build/demo-group
STORE  ?= $(OUT)/store
CONFIG ?= pipelines/group.toml
RUN    ?= group
MODEL  ?= group
# The song that is looked at.
SONG   ?= $(firstword $(sort $(wildcard $(DATA)/music/gunroar/*.ogg)))

.DEFAULT_GOAL := demo-group
include $(dir $(lastword $(MAKEFILE_LIST)))common.mk
include $(PIPELINES)songs.mk

# γ, and how runs are called.
DEGREES := apart=-1 neutral=0 unison=1

.PHONY: demo-group
demo-group:
	$(call unless_done,demo-group,$(ANSWERED))
	@echo
	@echo "tables   $(STORE)"
	@echo "answers  $(ANSWERS)"
	@echo "model    $(STORE)/models/$(MODEL)"
	@echo "report   $(OUT)/report.html"
	@echo "motion   $(PAGE) (open it in a browser)"

# library: groups of two to five dancers.
LIBRARY := $(STAMPS)/library.done
$(LIBRARY): | $(EXTRACTED) $(WITH)
	$(call stage,$(MOTIONGEN) library --config $(CONFIG) --store $(STORE) --dancers 2..5)

TRAINED := $(STAMPS)/train-$(RUN).done
$(TRAINED): | $(LIBRARY) $(WITH)
	$(call stage,$(MOTIONGEN) train --config $(CONFIG) --store $(STORE) --family group --run $(RUN))

EXPORTED := $(STAMPS)/export-$(MODEL).done
$(EXPORTED): | $(TRAINED) $(WITH)
	$(call stage,$(MOTIONGEN) export --config $(CONFIG) --store $(STORE) --run $(RUN) --model $(MODEL) --force)

# generate and evaluate: groups for the songs that were held out, at every degree.
name_of = $(firstword $(subst =, ,$(1)))
EVALUATED := $(foreach d,$(DEGREES),$(STAMPS)/evaluate-$(call name_of,$(d)).done)
define degree
$(STAMPS)/generate-$(call name_of,$(1)).done: | $(EXPORTED) $(WITH)
	$$(call stage,$$(MOTIONGEN) generate --config $$(CONFIG) --store $$(STORE) --model $$(MODEL) --dancers 5 \
	  --split test --run $(call name_of,$(1)) --consistency $(lastword $(subst =, ,$(1))))
$(STAMPS)/evaluate-$(call name_of,$(1)).done: | $(STAMPS)/generate-$(call name_of,$(1)).done $(WITH)
	$$(call stage,$$(MOTIONGEN) evaluate --config $$(CONFIG) --store $$(STORE) --run $(call name_of,$(1)) \
	  --report $$(OUT)/report.html)
endef
$(foreach d,$(DEGREES),$(eval $(call degree,$(d))))

PAGE := $(OUT)/motion/$(basename $(notdir $(SONG))).html
SHOWN := $(STAMPS)/page-$(MODEL).done
$(SHOWN): | $(EXPORTED) $(WITH)
	$(call stage,$(MOTIONGEN) generate --config $(CONFIG) --model $(STORE)/models/$(MODEL) --audio $(SONG) \
	  --output $(OUT)/motion --dancers 5 --consistency 0.5 --format npy$(comma)glb$(comma)png$(comma)html,$(PAGE))

define UNISON
select unison, count(*) as phrases, round(avg(n_dancers), 2) as dancers
from phrases where n_dancers > 1 group by unison order by unison
endef
define DIAL
select g.consistency, m.subject, m.metric, round(m.value, 3) as value, round(m.ci_low, 3) as ci_low,
round(m.ci_high, 3) as ci_high from metrics m
join (select distinct run, consistency from generations) g on g.run = m.run
where m.metric in ('\''unison_index'\'', '\''gmc_correlation'\'', '\''tif'\'', '\''group_locking'\'', '\''gmr'\'')
and m.variant = '\'''\'' order by m.metric, m.subject, g.consistency
endef

ANSWERED := $(STAMPS)/answers.done
$(ANSWERED): | $(EVALUATED) $(SHOWN) $(WITH)
	@rm -f $(ANSWERS).new
	$(call ask,How groups belong together,UNISON)
	$(call ask,What consistency does,DIAL)
	$(call stage,mv $(ANSWERS).new $(ANSWERS),$(ANSWERS))
