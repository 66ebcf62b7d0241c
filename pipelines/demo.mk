# The demo: real music and real motion capture (tests/data) become tables, the music's features are
# extracted, phrases to train on are constructed from both, small networks are trained on them, they
# become ONNX files, motion is made for all songs and evaluated, and queries answer.
#
#   make demo                              builds first
#   make -f pipelines/demo.mk BIN=…        with executables that are there already

DATA   ?= tests/data
OUT    ?= build/demo
STORE  ?= $(OUT)/store
CONFIG ?= pipelines/demo.toml
RUN    ?= demo
MODEL  ?= demo
# The song that is looked at.
SONG   ?= $(firstword $(sort $(wildcard $(DATA)/music/gunroar/*.ogg)))

.DEFAULT_GOAL := demo
include $(dir $(lastword $(MAKEFILE_LIST)))common.mk
include $(PIPELINES)songs.mk

.PHONY: demo
demo:
	$(call unless_done,demo,$(ANSWERED))
	@echo
	@echo "tables   $(STORE)"
	@echo "answers  $(ANSWERS)"
	@echo "plot     $(PLOT)"
	@echo "model    $(STORE)/models/$(MODEL)"
	@echo "motion   $(PAGE) (open it in a browser)"
	@echo "report   $(REPORT) (open it in a browser)"
	@echo "verdicts $(MOTIONGEN) query --store $(STORE) \"select verdict, test, outcome, message from verdicts \
	where split = 'held_out'\""

# library: phrases to train on, constructed from the songs and the captures.
LIBRARY := $(STAMPS)/library.done
$(LIBRARY): | $(EXTRACTED) $(WITH)
	$(call stage,$(MOTIONGEN) library --config $(CONFIG) --store $(STORE))

# train: a network that is small enough to learn in minutes.
TRAINED := $(STAMPS)/train-$(RUN).done
$(TRAINED): | $(LIBRARY) $(WITH)
	$(call stage,$(MOTIONGEN) train --config $(CONFIG) --store $(STORE) --run $(RUN))
PLOT := $(OUT)/training-$(RUN).png
PLOTTED := $(STAMPS)/plot-$(RUN).done
$(PLOTTED): | $(TRAINED) $(WITH)
	$(call stage,$(MOTIONGEN) plot training --store $(STORE) --run $(RUN) --output $(PLOT),$(PLOT))

# export: the networks as ONNX files, held against the interpreter that trained them.
EXPORTED := $(STAMPS)/export-$(MODEL).done
$(EXPORTED): | $(TRAINED) $(WITH)
	$(call stage,$(MOTIONGEN) export --config $(CONFIG) --store $(STORE) --run $(RUN) --model $(MODEL) --force)

# generate: motion for every song in tables, and for one of them in files that can be looked at.
GENERATED := $(STAMPS)/generate-$(MODEL).done
$(GENERATED): | $(EXPORTED) $(WITH)
	$(call stage,$(MOTIONGEN) generate --config $(CONFIG) --store $(STORE) --model $(MODEL))
PAGE := $(OUT)/motion/$(basename $(notdir $(SONG))).html
SHOWN := $(STAMPS)/page-$(MODEL).done
$(SHOWN): | $(EXPORTED) $(WITH)
	$(call stage,$(MOTIONGEN) generate --config $(CONFIG) --model $(STORE)/models/$(MODEL) --audio $(SONG) \
	  --output $(OUT)/motion --samples 1 --format npy$(comma)glb$(comma)png$(comma)html,$(PAGE))

# evaluate: checks, metrics and baselines of what was danced.
REPORT := $(OUT)/report.html
EVALUATED := $(STAMPS)/evaluate-$(MODEL).done
$(EVALUATED): | $(GENERATED) $(WITH)
	$(call stage,$(MOTIONGEN) evaluate --config $(CONFIG) --store $(STORE) --run $(MODEL) \
	  --report $(REPORT),$(REPORT))

# query: what the tables tell.
define SPLITS
select split, count(*) as phrases, round(sum(duration_s), 1) as seconds
from phrases group by split order by split
endef
define LONGEST_SONGS
select phrase_id, round(duration_s, 1) as seconds, round(tempo_bpm, 1) as tempo_bpm, tempo_source
from phrases where has_audio order by duration_s desc, phrase_id limit 5
endef
define SPEEDS
select m.phrase_id, count(*) as frames,
round(avg(sqrt(m.velocity_x * m.velocity_x + m.velocity_y * m.velocity_y + m.velocity_z * m.velocity_z)), 2)
as mean_speed_m_per_s
from motion m join phrases p on m.phrase_id = p.phrase_id
where not p.has_features group by m.phrase_id order by mean_speed_m_per_s desc, m.phrase_id
endef
define LOUDNESS
select e.phrase_id, round(e.tempo_bpm, 1) as tempo_bpm, e.n_beats, round(avg(f.rms), 3) as mean_rms,
round(avg(f.onset_strength), 3) as mean_onset_strength, round(avg(f.spectral_centroid), 3) as mean_centroid
from extractions e join features f on e.phrase_id = f.phrase_id
group by e.phrase_id, e.tempo_bpm, e.n_beats order by e.phrase_id
endef
define CONSTRUCTED
select p.split, count(distinct p.source) as songs, count(distinct p.phrase_id) as phrases,
round(avg(m.velocity_y * m.velocity_y), 4) as mean_square_of_vertical_velocity,
round(max(sqrt(m.velocity_x * m.velocity_x + m.velocity_z * m.velocity_z)), 2) as top_speed_m_per_s
from phrases p join motion m on p.phrase_id = m.phrase_id
where p.has_features and not p.has_audio group by p.split order by p.split
endef
define TRAINING
select run, stage, kind, count(*) as rows, max(step) as steps, round(max(elapsed_s), 1) as seconds,
round(min(loss), 4) as lowest_loss from training_log
group by run, stage, kind order by run, stage, kind
endef
define CHECKS
select model, check, precision, n_samples, n_frames, round(max_abs * 1000000, 2) as max_difference_e6,
passed from onnx_checks order by model, check, n_samples, n_frames
endef
define GENERATIONS
select g.phrase_id, round(g.n_frames / 30.0, 1) as seconds, g.n_windows as windows, round(g.score, 3) as score,
g.checks_passed, g.n_checks, round(g.locking, 3) as bar_locking, round(g.real_time_factor, 3) as real_time_factor
from generations g where g.selected and g.sample = 0 order by g.phrase_id limit 8
endef
# Quotes on the way to the shell, which has the query in quotes of its own.
define VERDICTS
select verdict, verdict_outcome, test, outcome, round(value, 3) as value, rule, round(threshold, 3) as threshold, against
from verdicts where split = '\''held_out'\'' order by verdict, test
endef

ANSWERED := $(STAMPS)/answers.done
$(ANSWERED): | $(INGESTED) $(EXTRACTED) $(LIBRARY) $(TRAINED) $(EXPORTED) $(PLOTTED) $(GENERATED) $(SHOWN) \
  $(EVALUATED) $(WITH)
	@{ echo; echo 'What is there?'; $(MOTIONGEN) query --store $(STORE) --tables; } | tee $(ANSWERS).new
	$(call ask,How much is in each split?,SPLITS)
	$(call ask,Which songs are the longest$(comma) and what is their tempo?,LONGEST_SONGS)
	$(call ask,How fast does each capture move?,SPEEDS)
	$(call ask,What do the songs sound like?,LOUDNESS)
	$(call ask,What was constructed to train on?,CONSTRUCTED)
	$(call ask,What did training bring?,TRAINING)
	$(call ask,Does onnxruntime answer what was trained?,CHECKS)
	$(call ask,What was danced$(comma) and how well?,GENERATIONS)
	$(call ask,What may be said of motion for songs that nothing was learned from?,VERDICTS)
	$(call stage,mv $(ANSWERS).new $(ANSWERS),$(ANSWERS))
