# Shared by the demos: the songs and captures of tests/data become tables, the songs' features are extracted, and queries
# answer.
#
# Before including this file and after common.mk, a pipeline sets DATA, STORE and CONFIG.

SOURCES := phrases music
ANSWERS := $(OUT)/queries.txt

# ingest: both sources into one store.
$(foreach s,$(SOURCES),$(call watch,$(s),$(DATA)/$(s),$(STORE)))
$(call prune)
WITH := $(CONFIG) $(PROGRAM) $(MOTIONGEN)
INGESTED := $(SOURCES:%=$(STAMPS)/ingest-%.done)
$(INGESTED): $(STAMPS)/ingest-%.done: | $(STAMPS)/%.list $(WITH)
	$(call stage,$(MOTIONGEN) ingest --config $(CONFIG) --source $(DATA)/$* --store $(STORE))

# extract: the audio features of every song.
EXTRACTED := $(STAMPS)/extract.done
$(EXTRACTED): | $(INGESTED) $(WITH)
	$(call stage,$(MOTIONGEN) extract --config $(CONFIG) --store $(STORE))

# $(call ask,QUESTION,QUERY) puts the answer of a query, a variable of any number of lines, behind the others.
# Lines become spaces on the way to the shell.
define newline


endef
comma := ,
ask = @{ echo; echo '$(1)'; $(MOTIONGEN) query --config $(CONFIG) --store $(STORE) \
	'$(subst $(newline), ,$($(2)))'; } | tee --append $(ANSWERS).new
