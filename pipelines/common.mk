# Shared by the pipelines: where things lie, and how a stage is run.
#
# Before including this file, a pipeline sets OUT and STORE.
#
# A stamp says that a stage did its work for these inputs. Stamps lie on this machine even where the
# store does not. Losing them costs little, because a stage itself skips what the store has already.

MAKEFLAGS += --no-builtin-rules --no-print-directory
SHELL := bash
.SHELLFLAGS := -eu -o pipefail -c
.DELETE_ON_ERROR:

PIPELINE  := $(firstword $(MAKEFILE_LIST))
PIPELINES := $(dir $(lastword $(MAKEFILE_LIST)))
BIN       ?= target/debug
MOTIONGEN ?= $(BIN)/motiongen
STAMPS    := $(OUT)/stamps

# Stamps mean nothing without their store, nor do those of stages in which items failed: such a
# stage tries the failed items again next time. (A remote store is taken to be there.)
$(shell case '$(STORE)' in (*://*) ;; (*) [ -d '$(STORE)/commits' ] || rm -f $(STAMPS)/*.done ;; esac)
$(shell grep --files-with-matches --no-messages 'failed' $(STAMPS)/*.done | xargs --no-run-if-empty rm)

# $(call watch,NAME,SOURCE,SETTINGS) keeps $(STAMPS)/NAME.list up to date with what SOURCE holds.
watch = $(shell $(PIPELINES)watch.sh $(STAMPS)/$(1).list '$(2)' $(3))

# $(call stage,COMMAND) runs a stage and stamps it. Exit code 1 means that some items failed, which
# are in the table of failures while the rest is done: the pipeline says so and goes on. Any other
# code stops it.
define stage
@mkdir -p $(@D)
@echo "$(1)"
@code=0; $(1) || code=$$?; \
case $$code in \
  0) echo done > $@ ;; \
  1) echo 'some items failed' > $@; \
     echo "$(basename $(@F)): some items failed (see above); going on, they are tried again next time" >&2 ;; \
  *) exit $$code ;; \
esac
endef

# $(call unless_done,NAME,TARGET) makes TARGET, or says that there is nothing to make.
define unless_done
+@if $(MAKE) --file $(PIPELINE) --question $(2) 2> /dev/null; \
then echo "$(1): everything is up to date"; \
else $(MAKE) --file $(PIPELINE) $(2); fi
endef

$(MOTIONGEN):
	@echo '$@ is missing; build it with: cargo build --bins (or name another with BIN=…)' >&2; exit 2
