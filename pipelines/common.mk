# Shared by the pipelines: where things lie, and how a stage is run.
#
# Before including this file, a pipeline sets OUT and STORE.
#
# A stamp says that a stage did its work for these inputs, by their digests (stamp.sh); clocks say nothing. What a
# rule needs stands behind |, so that make asks only whether the stamp is there. Stamps lie on this machine even
# where the store does not. Losing them costs little, because a stage itself skips what the store has already.

MAKEFLAGS += --no-builtin-rules --no-print-directory
SHELL := bash
.SHELLFLAGS := -eu -o pipefail -c
.DELETE_ON_ERROR:

PIPELINE  := $(firstword $(MAKEFILE_LIST))
PIPELINES := $(dir $(lastword $(MAKEFILE_LIST)))
BIN       ?= target/debug
MOTIONGEN ?= $(BIN)/motiongen
STAMPS    := $(OUT)/stamps

# Stamps mean nothing without their store. (A remote store is taken to be there.)
$(shell case '$(STORE)' in (*://*) ;; (*) [ -d '$(STORE)/commits' ] || rm -f $(STAMPS)/*.done ;; esac)

# $(call watch,NAME,SOURCE,SETTINGS) keeps $(STAMPS)/NAME.list up to date with what SOURCE holds.
watch = $(shell $(PIPELINES)watch.sh $(STAMPS)/$(1).list '$(2)' $(3))

# The program by its content, which is digested again where its size or time is another.
PROGRAM := $(STAMPS)/program.list
$(shell $(PIPELINES)watch.sh --program $(PROGRAM) '$(MOTIONGEN)')

# $(call prune) removes the stamps that are not of the present files; to be called when all lists are made.
prune = $(shell $(PIPELINES)stamp.sh prune $(STAMPS))

# $(call stage,COMMAND,FILES) runs a stage and, when it is done, stamps it with the digests of all that stands behind
# | in its rule, and of the FILES that it made. Exit code 1 means that some items failed, which are in the table of
# failures while the rest is done: the pipeline says so, goes on, and tries them again next time. Any other code stops
# it, 75 (stopped before it was done) too; without a stamp, the next make goes on there.
stage = @$(PIPELINES)stamp.sh run $@ $(filter-out $(MOTIONGEN),$|) $(if $(2),--made $(2)) -- $(1)

# $(call unless_done,NAME,TARGET) makes TARGET, or says that there is nothing to make.
define unless_done
+@if $(MAKE) --file $(PIPELINE) --question $(2) 2> /dev/null; \
then echo "$(1): everything is up to date"; \
else $(MAKE) --file $(PIPELINE) $(2); fi
endef

$(MOTIONGEN):
	@echo '$@ is missing; build it with: cargo build --bins (or name another with BIN=…)' >&2; exit 2
