//! The tables of a store. `schemas/*.json` and `docs/tables.md` are generated from this file.

use std::borrow::Cow;

use super::schema::{
    Column, ColumnType, DANCER_COLUMN, FRAME_COLUMN, Row, TableSchema, TimestampUs, rows,
};
use crate::audio::feature_names;
use crate::motion::{CHANNEL_NAMES, channel_unit};

/// The column that names the phrase a row belongs to.
const ITEM_COLUMN: &str = "phrase_id";

rows! {
    "One row per phrase that ingest accepted or library constructed."
    PhraseRow in "phrases" version 5 reads 2 sorted by [phrase_id]
    {
        phrase_id: String, "", "Name of the phrase: its folder in a phrase layout, its relative path in a music library; of a constructed one `SONG.tTAKE.NUMBER`.";
        source: String, "URL", "The source it came from; of a constructed phrase, the song.";
        motion_url: Option<String>, "URL", "The file that the motion was read from; of a group with a file for each dancer, that of the first.";
        features_url: Option<String>, "URL", "The feature file (`features.npz`).";
        audio_url: Option<String>, "URL", "The audio file.";
        beats_url: Option<String>, "URL", "The beat list (`.beats.txt`).";
        motion_bytes: Option<i64>, "bytes", "Size of the motion file, or of those of all dancers.";
        features_bytes: Option<i64>, "bytes", "Size of the feature file.";
        audio_bytes: Option<i64>, "bytes", "Size of the audio file.";
        beats_bytes: Option<i64>, "bytes", "Size of the beat list.";
        content_hash: String, "BLAKE3", "Digest of the phrase's files: BLAKE3 over one line `role digest` per file, roles sorted; of a constructed phrase, over its features and motion as little-endian 32-bit floats.";
        song_hash: Option<String>, "BLAKE3", "Identity of the music, whatever it is called and whatever lies beside it: digest of the audio file, without audio of the feature file; of a constructed phrase, that of its song. None where there is neither, and in rows of release 0.1.";
        has_motion: bool, "", "Whether the phrase has motion.";
        has_features: bool, "", "Whether the phrase has a feature file, or was constructed with features.";
        has_audio: bool, "", "Whether the phrase has audio.";
        has_beats: bool, "", "Whether the phrase has beat times (beat list, feature file, or those of its song).";
        motion_format: Option<String>, "", "`npy` (25 channels as they were), the format that was converted (`bvh`, `aist`, `amass`, `gdance`, `smpl`, `positions`, `humanml3d`, `vmd`, `vmd_camera`) or `constructed` (by library).";
        motion_root: Option<String>, "", "Of a capture: the joint whose motion it is, the first that moves or branches. This and the columns to `motion_notes` are none for other motion, and in rows of release 0.1.";
        motion_up: Option<String>, "", "Of a capture: the axis that is up in the file, found or given by --up: `y`, `z`, `x`, `-y`, `-z` or `-x`.";
        motion_unit_m: Option<f64>, "m", "Of a capture: length of one file unit, guessed from the lengths of bones.";
        motion_cut_s: Option<f64>, "s", "Of a capture: what was cut off at the start, a pose that the body jumps out of.";
        motion_notes: Option<String>, "", "Of a capture: what a reader should know, such as a root that stands still or a guessed unit, with semicolons between; none where there is nothing.";
        audio_codec: Option<String>, "", "Codec named by the audio header.";
        sample_rate_hz: Option<i32>, "Hz", "Sample rate named by the audio header.";
        n_channels: Option<i32>, "channels", "Channels named by the audio header.";
        duration_s: f64, "s", "Length of the audio; without audio, frames / 30.";
        start_s: Option<f64>, "s", "Of a constructed phrase, where in its song it begins.";
        n_frames: Option<i64>, "frames", "Motion frames at 30 fps, of each dancer.";
        n_feature_frames: Option<i64>, "frames", "Frames in the feature file, or of the features.";
        split: String, "", "`train` (90 %), `validation` (5 %) or `test` (5 %), by a stable hash of `phrase_id`; constructed phrases go with their song.";
        tempo_bpm: Option<f64>, "beats/min", "Tempo.";
        tempo_source: Option<String>, "", "Where the tempo came from: `beats_file`, `features`, or, of constructed phrases, `beat_tracker` or `composed` (the song was played from a score).";
        beats_per_bar: Option<i32>, "beats", "Beats in a bar.";
        beats_per_bar_source: Option<String>, "", "Where that came from: `beats_file` (numbered beats), `composed` (the song was played from a score), `tracker` (found in the audio) or `default`.";
        n_dancers: Option<i32>, "dancers", "Dancers in the motion, 1 of a soloist. None without motion, and in rows of versions before 5, where motion is a soloist's.";
        formation: Option<String>, "", "Of a constructed group: the shape that its dancers stand in: `line`, `v`, `circle`, `rows` or `scatter`; none where no shape holds three quarters of the phrase, and otherwise.";
        unison: Option<String>, "", "Of a constructed group: how its dancers' steps are related: `same`, `mirrored`, `canon`, `call_and_response` or `free`; none where no kind holds three quarters of the phrase, and otherwise.";
        style_name: Option<String>, "", "Name of the style of the motion, such as a dance genre: what `motion/ID/style.txt` says, else the genre in the name of a recording of AIST++ (`gHO_sBM_…`); none where there is neither, and in rows of releases before 0.3.";
    }
}

/// `motion_format` of a phrase that library constructed.
pub const CONSTRUCTED: &str = "constructed";

impl PhraseRow {
    /// Returns whether library constructed the phrase.
    pub fn is_constructed(&self) -> bool {
        self.motion_format.as_deref() == Some(CONSTRUCTED)
    }

    /// Returns how many dancers the motion has: 0 without motion, 1 where the row is older than groups.
    pub fn count_dancers(&self) -> usize {
        let n_dancers = self.n_dancers.unwrap_or(i32::from(self.has_motion));
        usize::try_from(n_dancers).unwrap_or(0)
    }
}

rows! {
    "One row per item that a stage could not do; a later success removes it."
    FailureRow in "failures" version 1 sorted by [phrase_id]
    {
        stage: String, "", "The stage that failed.";
        phrase_id: String, "", "The item, as the stage would have named it.";
        source: String, "URL", "The file at fault, or the source's folder.";
        kind: String, "", "Class of the failure, for grouping.";
        message: String, "", "What is wrong and what to do about it.";
        time: TimestampUs, "", "When it failed.";
    }
}

rows! {
    "One row per phrase whose features extract has, with what holds for the whole phrase."
    ExtractionRow in "extractions" version 3 reads 1 sorted by [phrase_id]
    {
        phrase_id: String, "", "The phrase, as in `phrases`.";
        origin: String, "", "`audio` (extracted here) or `feature_file` (brought in from `features.npz`, as it was).";
        source_url: String, "URL", "The file that the features came from.";
        n_frames: i64, "frames", "Feature frames: 1 + n_samples / 1470, rounded down.";
        n_samples: Option<i64>, "samples", "Length of the audio at 44.1 kHz.";
        duration_s: f64, "s", "Length of the audio; without audio, frames / 30.";
        tuning: Option<f64>, "1/36 octave", "Deviation from A440 with which the chroma was made, from -0.5 to below 0.5.";
        tuning_source: Option<String>, "", "`estimated` or `given` (by --tuning).";
        tempo_bpm: Option<f64>, "beats/min", "Tempo that belongs to the features, librosa's: 1800 / whole frames; none without onsets.";
        n_beats: i32, "beats", "Beats that belong to the features: librosa's, or those of the feature file. Those that motion follows are in `beats`.";
        audio_codec: Option<String>, "", "Codec that was decoded.";
        sample_rate_hz: Option<i32>, "Hz", "Sample rate of the file.";
        n_channels: Option<i32>, "channels", "Channels of the file.";
        content_hash: Option<String>, "BLAKE3", "`content_hash` of the phrase when its features were extracted; where `phrases` has another, the features are of files that were replaced. None in rows of version 1.";
        truncated: Option<bool>, "", "Whether the audio ends more than a frame before the end that its header states. This and `lost_s` are none without audio, and in rows of versions 1 and 2.";
        lost_s: Option<f64>, "s", "Audio that is missing at such an end or that could not be decoded; of the latter, more than a thousandth or 1 s fails the phrase instead.";
    }
}

rows! {
    "One row per beat: those of the beat list where a phrase has one, else those that extract found."
    BeatRow in "beats" version 2 reads 1 sorted by [phrase_id, beat]
    {
        phrase_id: String, "", "The phrase, as in `phrases`.";
        beat: i32, "beats", "Index within the phrase, from 0.";
        frame: i32, "frames", "The nearest frame of the phrase.";
        time_s: f64, "s", "Time of the beat. In a constructed phrase, from its begin, and beyond the first and last beat of the song at its median interval.";
        number: Option<i32>, "beats", "Number in the bar, 1 on the downbeat; none where nobody knows.";
        source: Option<String>, "", "Where the beat came from: `beats_file` (ingest read the beat list), `features` (`beat_times` of a feature file), `tracker` (found in the audio, by hypotheses over the whole song) or `composed` (library played the song from a score that has it); of a constructed phrase, where those of its song came from. None in rows that release 0.1 wrote.";
    }
}

rows! {
    "One row per training step, epoch and validation of a run."
    TrainingLogRow in "training_log" version 3 reads 1 sorted by [segment, step]
    {
        segment: String, "", "The stretch of the log, from one checkpoint to the next: `run/stage/` and the steps done before it.";
        run: String, "", "Name of the run.";
        stage: String, "", "`diffusion` (the UNet), `decoder`, `finetune` (both, end to end), `group` (denoiser and score of groups), `tokens` (a tokenizer) or `planner` (of its tokens).";
        kind: String, "", "`step`, `epoch` (means over its steps) or `validation`.";
        epoch: i32, "epochs", "Epoch, from 1.";
        step: i64, "steps", "Steps done, this one included.";
        learning_rate: Option<f64>, "", "Learning rate of the step; in finetune that of the UNet.";
        lr_decoder: Option<f64>, "", "Learning rate of the decoder in finetune.";
        loss: Option<f64>, "", "What is minimised; of a validation, with the weights that would be used (the average, in diffusion and decoder). None where it was not finite.";
        loss_live: Option<f64>, "", "Of a validation: the loss of the weights themselves rather than their average.";
        diffusion: Option<f64>, "", "Mean loss of the prediction of the UNet, or of another family's denoiser.";
        reconstruction: Option<f64>, "", "Mean squared error of decoded motion over all channels, in units of their spread; of a tokenizer the loss of its draft.";
        decoder_position: Option<f64>, "m²", "Mean squared error of decoded positions.";
        decoder_quaternion: Option<f64>, "", "Mean squared error of decoded quaternions, of the nearer sign.";
        velocity_coherence: Option<f64>, "", "10 ⟨(v − 30 Δp)²⟩ / 5².";
        acceleration_coherence: Option<f64>, "", "5 ⟨(a − 30 Δv)²⟩ / 100².";
        jerk: Option<f64>, "", "⟨‖30 Δa‖²⟩ / 50000².";
        quaternion_delta: Option<f64>, "", "2 ⟨max(0.95 − |q · q'|, 0)⟩.";
        phase_monotonic: Option<f64>, "", "Falls of the phase within bars, summed over a motion.";
        position_smoothness: Option<f64>, "m", "⟨max(|Δp| − 0.5, 0)⟩.";
        velocity_error: Option<f64>, "m/s", "Of a validation in finetune: mean |v − 30 Δp| of motion that was sampled from noise and decoded.";
        acceleration_error: Option<f64>, "m/s²", "Of a validation in finetune: mean |a − 30 Δv|.";
        quaternion_pass_rate: Option<f64>, "", "Of a validation in finetune: share of sampled motions whose turns from frame to frame all keep |q · q'| ≥ 0.95.";
        speed_ratio: Option<f64>, "", "Of a validation in finetune: mean speed of sampled motion, over that of the phrases; far below 1 where motion agrees with itself because it stands still.";
        markers: Option<f64>, "m²", "Of a model of groups: mean squared error of points fixed to each body. This and `contrast` are none in rows of version 1.";
        contrast: Option<f64>, "", "Of a model of groups: cross-entropy of telling a group from mixed ones.";
        sampled_distance: Option<f64>, "", "Of a validation in diffusion with --keep motion: root mean square of the logarithms of how motion sampled for validation windows moves, over how real motion moves: locking to the bar, speed along each axis, jerk, turning and changes of turning; 0 is alike. The checkpoint with the least is kept. None otherwise, and in rows before version 3.";
        commitment: Option<f64>, "", "Of a tokenizer: mean squared distance of latents from their codes. This and `perplexity` are none in rows of versions before 3.";
        perplexity: Option<f64>, "codes", "Of a tokenizer: how many codes are in use, were all used alike: exp(−Σ p ln p) over the tokens of the batch, or of all validation windows.";
        gradient_norm: Option<f64>, "", "Norm of the gradient before it was clipped.";
        skipped: bool, "", "Whether the step was skipped because something was not finite.";
        samples_per_s: Option<f64>, "1/s", "Windows learned from per second.";
        data_wait_s: Option<f64>, "s", "How long the step waited for its batch.";
        rss_bytes: Option<i64>, "bytes", "Memory of the process after the step.";
        elapsed_s: f64, "s", "Time that the stage has trained, over all resumptions.";
        time: TimestampUs, "", "When the row was made.";
    }
}

rows! {
    "One row per check of an exported model: what onnxruntime answers, held against the interpreter that trained it."
    OnnxCheckRow in "onnx_checks" version 1 sorted by [model, check, n_samples, n_frames]
    {
        model: String, "", "Name of the model.";
        run: String, "", "The run that it was exported from.";
        check: String, "", "`forward` (one prediction of the UNet), `sample` (all steps of DDIM), `guided_sample` (the same with guidance), `decode` (the decoder on what was sampled), `rounding` (all steps of DDIM with rounded weights against the trained ones); of a model of groups `score` (log f) and `agreement` (the part of it that is the dancers'); of a model of tokens also `tokens` (share of the encoder's that are others), `signal`, `planner`, and `planner_step` (position by position with what is kept, against the whole planner).";
        precision: String, "", "How the weights are stored: `fp32`, `fp16` or `int8`.";
        n_samples: i32, "samples", "Motions of the batch.";
        n_frames: i32, "frames", "Frames of each.";
        n_steps: Option<i32>, "steps", "Steps of DDIM.";
        guidance: Option<f64>, "", "Guidance of the sampling.";
        max_abs: f64, "", "Largest difference, in normalised units.";
        rms: f64, "", "Root mean square of the differences.";
        tolerance: f64, "", "What the check allows: of `rounding` the rms, of all others the largest difference.";
        passed: bool, "", "Whether the difference is allowed.";
        onnx_s: Option<f64>, "s", "Time that onnxruntime took.";
        eager_s: f64, "s", "Time that our own interpreter took.";
        runtime: String, "", "The build of onnxruntime.";
        time: TimestampUs, "", "When the check was made.";
    }
}

rows! {
    "One row per motion that generate sampled, kept or not; measured times differ from run to run, nothing else does."
    GenerationRow in "generations" version 5 reads 1 sorted by [generation, candidate]
    {
        generation: String, "", "The motion: `RUN/PHRASE/SAMPLE`.";
        run: String, "", "Name of the generation (--run), by default that of the model.";
        phrase_id: String, "", "The phrase whose music it was made for, as in `phrases`.";
        sample: i32, "samples", "Number of the motion among those of the phrase, from 0.";
        candidate: i32, "", "Number of the candidate for the sample, from 0; more than one with --best-of.";
        selected: bool, "", "Whether it is the candidate that was kept; its frames are in `generated`.";
        seed: i64, "", "Seed of its noise, which follows from --seed, the phrase, the sample and the candidate.";
        model: String, "", "Name of the model.";
        weights: String, "SHA-256", "Digest of the model's weights, UNet and decoder.";
        engine: String, "", "What ran the model: `onnx` or `eager`.";
        sampler: String, "", "Name of the sampler.";
        n_steps: i32, "steps", "Steps of the sampler.";
        guidance: f64, "", "Guidance: 1 follows the music, more exaggerates it.";
        eta: Option<f64>, "", "Of DDIM, the share of the noise that is renewed.";
        primed_by: Option<String>, "", "The library phrases that sampling began from, one for each window, with commas between.";
        n_frames: i64, "frames", "Frames of the motion.";
        n_windows: i32, "windows", "Windows that it was sampled in.";
        score: Option<f64>, "", "Score of the selection, from 0 to 1; none where a value is not finite.";
        checks_passed: i32, "checks", "Sanity checks passed, of the reference's and the strict ones.";
        n_checks: i32, "checks", "Sanity checks made.";
        locking: Option<f64>, "", "R² of the vertical velocity with the bar's phase, less its mean at wrong tempi; none without beats.";
        velocity_error: f64, "m/s", "Mean |v − 30 Δp| of the motion as it was decoded, before post-processing.";
        control_error_mm: Option<f64>, "mm", "Largest distance from a constraint on the position.";
        control_error_deg: Option<f64>, "°", "Largest angle from a constraint on the orientation.";
        constraints: Option<String>, "JSON", "What the motion was asked to do, frame by frame, as `generate --constraints` reads it; none where it was asked for nothing, and in rows of versions before 5.";
        generate_s: f64, "s", "Time that sampling, decoding and post-processing took.";
        real_time_factor: f64, "", "That time over the length of the motion.";
        settings: Option<String>, "JSON", "What determines the motion beside its music, the model's weights and the seed: sampler, guidance, candidates, style, overlap, priming, post-processing, and of constraints the digest. None where release 0.1 made it.";
        content_hash: Option<String>, "BLAKE3", "`content_hash` of the phrase that it was made for, as it was then; where `phrases` has another, the motion is for music that was replaced. None in rows of versions 1 and 2.";
        n_dancers: Option<i32>, "dancers", "Dancers in the motion, 1 of a soloist. None in rows of versions before 4, where it is 1.";
        consistency: Option<f64>, "", "Of a model of groups γ, the guidance towards consistency (above 0) or diversity (below 0), from -1 to 1; of several dancers by a model of tokens the share of the first dancer's tokens that the others keep, from 0 to 1; none otherwise.";
        time: TimestampUs, "", "When it was made.";
    }
}

impl GenerationRow {
    /// Returns how many dancers the motion has, 1 where the row is older than groups.
    pub fn count_dancers(&self) -> usize {
        usize::try_from(self.n_dancers.unwrap_or(1)).unwrap_or(1)
    }
}

rows! {
    "One row per token of a dancer's motion."
    TokenRow in "tokens" version 1 sorted by [tokenization, dancer, position]
    {
        tokenization: String, "", "The tokens of a phrase: `RUN/PHRASE`, as in `tokenizations`.";
        run: String, "", "The run of train whose tokenizer wrote it.";
        phrase_id: String, "", "The phrase, as in `phrases`.";
        dancer: i32, "", "Number of the dancer, as in `motion`.";
        position: i32, "tokens", "Number of the token, from 0: it stands for `frames_per_token` frames, and in each window of training's length the last for those that are left.";
        token: i32, "", "Number of the code, from 0 to below `n_codes`.";
    }
}

rows! {
    "One row per dancer of a phrase that tokenize wrote as tokens, with what holds for all of them."
    TokenizationRow in "tokenizations" version 1 sorted by [tokenization, dancer]
    {
        tokenization: String, "", "The tokens of a phrase: `RUN/PHRASE`.";
        run: String, "", "The run of train whose tokenizer wrote them.";
        phrase_id: String, "", "The phrase, as in `phrases`.";
        dancer: i32, "", "Number of the dancer, as in `motion`.";
        weights: String, "SHA-256", "Digest of the tokenizer's weights, codebook included.";
        n_codes: i32, "codes", "K, rows of the codebook.";
        frames_per_token: i32, "frames", "ρ, frames that a token stands for.";
        n_frames: i64, "frames", "Frames of the motion.";
        n_tokens: i64, "tokens", "Tokens that stand for them.";
        position_error_m: Option<f64>, "m", "Mean distance of positions from those of motion that was made of the tokens again; none without --reconstruct.";
        orientation_error_deg: Option<f64>, "°", "Mean angle of orientations to those of that motion; none without --reconstruct.";
        content_hash: String, "BLAKE3", "`content_hash` of the phrase as it was then; where `phrases` has another, the tokens are of motion that was replaced.";
    }
}

rows! {
    "One row per sanity check of a motion that evaluate looked at."
    SanityCheckRow in "sanity_checks" version 2 reads 1 sorted by [run, phrase_id, sample]
    {
        run: String, "", "The run of generate that was evaluated, or the name of motions of another program; evaluating it again replaces its rows.";
        model: String, "", "Name of the model.";
        phrase_id: String, "", "The phrase, as in `phrases`.";
        sample: i32, "samples", "Number of the motion among those of the phrase.";
        stage: Option<String>, "", "`raw` (as decoded, before post-processing) or `final` (after it); of motions of another program `final`.";
        check_set: String, "", "`reference` (the five checks of the reference design) or `strict` (what captured motion keeps).";
        check_name: String, "", "Name of the check: see docs/evaluate.md.";
        by_construction: Option<bool>, "", "Whether post-processing makes the check pass whatever was decoded; such a check counts in no pass rate.";
        value: Option<f64>, "", "What was measured, of checks of windows the worst; none where it is not finite.";
        threshold: f64, "", "What the value is held against.";
        passed: bool, "", "Whether the motion passes; a check of windows is passed where nine in ten windows pass.";
        message: String, "", "Both in a few words, with their unit.";
    }
}

rows! {
    "One row per number of a run that evaluate measured, and of what it is compared with."
    MetricRow in "metrics" version 1 sorted by [run, metric, variant, split, subject]
    {
        run: String, "", "The run of generate that was evaluated, or the name of motions of another program; evaluating it again replaces its rows.";
        model: String, "", "Name of the model; empty for motions of another program.";
        subject: String, "", "Whose number it is: `generated`, or a baseline: `shuffled` (the same motions with the music of other songs), `shifted` (with the bars shifted by beats), `untrained` (motion of the same network with its first weights), `no_music` (of the trained network, its music withheld), `shuffled_plan` (of a model of tokens, the tokens of each window in an order of chance), `reconstructed` (real motion that a tokenizer made again of its tokens), `draft` (the same without the diffusion decoder), `retrieval` (the library's phrase with the nearest features), `mean_motion`, `held_out_truth`, `training_truth`; of groups also `independent` (soloists who were sampled one by one, in the places of the dancers) and `copied` (one dancer in the places of all).";
        split: String, "", "Which music: `held_out` (the model met none of it), `validation` (its checkpoints were chosen by it), `trained_on`, `unknown` (nobody knows), or `all` of these.";
        metric: String, "", "Name of the number: see docs/evaluate.md.";
        variant: String, "", "Which of several ways to measure it; empty where there is one. `raw` is of motion as it was decoded.";
        unit: String, "", "Unit of the value; empty where it has none.";
        value: Option<f64>, "", "The number; none where there is too little to tell.";
        ci_low: Option<f64>, "", "Lower end of its 95 % interval.";
        ci_high: Option<f64>, "", "Upper end of its 95 % interval.";
        n: i64, "", "What was counted: windows, chunks, songs or frames, as the protocol says.";
        protocol: String, "", "How it was measured.";
        time: TimestampUs, "", "When it was measured.";
    }
}

rows! {
    "One row per test that a verdict on a run rests on."
    VerdictRow in "verdicts" version 1 sorted by [run, split, verdict, test]
    {
        run: String, "", "The run of generate that was evaluated, or the name of motions of another program; evaluating it again replaces its rows.";
        model: String, "", "Name of the model; empty for motions of another program.";
        split: String, "", "Which music, as in `metrics`.";
        verdict: String, "", "`sound`, `like_real`, `follows_music` or `varied`; of groups also `together`.";
        verdict_outcome: String, "", "`won` (every test is won), `lost` (one is lost) or `open` (too little was measured).";
        test: String, "", "Name of the test: see docs/evaluate.md.";
        outcome: String, "", "`won`, `lost` or `open`.";
        statistic: String, "", "What was measured, in words.";
        value: Option<f64>, "", "The statistic; none where it was not measured.";
        ci_low: Option<f64>, "", "Lower end of its 95 % interval.";
        ci_high: Option<f64>, "", "Upper end of its 95 % interval.";
        unit: String, "", "Unit of the value; empty where it has none.";
        rule: String, "", "`at least`, `at most`, `above`, `below`, or a range.";
        threshold: f64, "", "The number of the rule; of a range the upper one.";
        against: String, "", "What the value is held against.";
        p: Option<f64>, "", "Probability by chance, of tests that have one.";
        p_holm: Option<f64>, "", "The same, adjusted for the tests of the verdict (Holm).";
        message: String, "", "All of it in a sentence.";
        time: TimestampUs, "", "When it was measured.";
    }
}

rows! {
    "One row per song and number of what was generated: what comparisons between runs are paired by."
    SongMetricRow in "song_metrics" version 1 sorted by [run, song, metric, variant, split]
    {
        run: String, "", "The run of generate that was evaluated, or the name of motions of another program; evaluating it again replaces its rows.";
        song: String, "", "The song: digest of its music, or its file where that is not known.";
        split: String, "", "Which music, as in `metrics`.";
        metric: String, "", "Name of the number, as in `metrics`.";
        variant: String, "", "Which of several ways to measure it, as in `metrics`.";
        value: f64, "", "The number of the song.";
    }
}

/// Name of the table of generated motion.
pub const GENERATED: &str = "generated";

/// Returns the schema of `generated`: one row per dancer and frame, named by run, phrase and sample.
pub fn generated() -> TableSchema {
    let mut table = TableSchema { name: GENERATED, ..motion() };
    table.description = "One row per dancer and frame of generated motion at 30 fps.";
    let column = |name: &'static str, column_type, unit, meaning: &'static str| Column {
        name: name.into(),
        column_type,
        nullable: false,
        absent: None,
        unit,
        description: meaning.into(),
    };
    table.columns[0] = column(
        "generation",
        ColumnType::Utf8,
        "",
        "The motion: `RUN/PHRASE/SAMPLE`, as in `generations`.",
    );
    let labels = [
        column("run", ColumnType::Utf8, "", "Name of the generation."),
        column(ITEM_COLUMN, ColumnType::Utf8, "", "The phrase, as in `phrases`."),
        column("sample", ColumnType::Int32, "samples", "Number of the motion among the phrase's."),
    ];
    table.columns.splice(1..1, labels);
    table.sorted_by = &["generation", DANCER_COLUMN, FRAME_COLUMN];
    table
}

/// Name of the table of decoded motion.
pub const DECODED: &str = "decoded";

/// Returns the schema of `decoded`: the columns of [`generated`].
pub fn decoded() -> TableSchema {
    let description =
        "One row per dancer and frame of a kept motion as it was decoded, before post-processing.";
    TableSchema { name: DECODED, description, ..generated() }
}

/// Name of the feature table.
pub const FEATURES: &str = "features";

/// Returns the schema of `features`: one row per frame, one column per feature.
pub fn features() -> TableSchema {
    let channels = feature_names().map(|(name, block)| Column {
        name,
        column_type: ColumnType::Float32,
        nullable: false,
        absent: None,
        unit: "",
        description: Cow::Borrowed(block.meaning),
    });
    let description = "One row per frame of music at 30 fps: the 163 audio features (docs/features.md). Those of a constructed phrase are an excerpt of its song's, relative to the whole song.";
    frame_table(FEATURES, description, channels)
}

/// Name of the motion table.
pub const MOTION: &str = "motion";

/// Returns the schema of `motion`: one row per dancer and frame, one column per channel.
pub fn motion() -> TableSchema {
    let channels = CHANNEL_NAMES.iter().enumerate().map(|(i, name)| Column {
        name: Cow::Borrowed(*name),
        column_type: ColumnType::Float32,
        nullable: false,
        absent: None,
        unit: channel_unit(i).unwrap_or_default(),
        description: Cow::Owned(format!("Channel {i} of the frame.")),
    });
    let description = "One row per dancer and motion frame at 30 fps; all dancers of a phrase have as many frames.";
    let mut table = frame_table(MOTION, description, channels);
    let dancer = Column {
        name: DANCER_COLUMN.into(),
        column_type: ColumnType::Int32,
        nullable: false,
        // Parts of version 1 hold soloists.
        absent: Some(0),
        unit: "dancers",
        description: "Number of the dancer in the group, from 0; 0 of a soloist.".into(),
    };
    table.columns.insert(1, dancer);
    TableSchema { version: 2, sorted_by: &[ITEM_COLUMN, DANCER_COLUMN, FRAME_COLUMN], ..table }
}

/// Builds the schema of a table with one row per frame and one named column per channel.
fn frame_table(
    name: &'static str,
    description: &'static str,
    channels: impl Iterator<Item = Column>,
) -> TableSchema {
    let id = |name: &'static str, column_type, unit, meaning: &'static str| Column {
        name: name.into(),
        column_type,
        nullable: false,
        absent: None,
        unit,
        description: meaning.into(),
    };
    let ids = [
        id(ITEM_COLUMN, ColumnType::Utf8, "", "The phrase, as in `phrases`."),
        id(
            FRAME_COLUMN,
            ColumnType::Int32,
            "frames",
            "Index within the phrase, from 0; time is frame / 30 s.",
        ),
    ];
    TableSchema {
        name,
        version: 1,
        oldest_version: 1,
        description,
        columns: ids.into_iter().chain(channels).collect(),
        sorted_by: &[ITEM_COLUMN, FRAME_COLUMN],
    }
}

/// Returns every table of a store.
pub fn all() -> Vec<TableSchema> {
    vec![
        PhraseRow::schema(),
        motion(),
        features(),
        ExtractionRow::schema(),
        BeatRow::schema(),
        FailureRow::schema(),
        TrainingLogRow::schema(),
        OnnxCheckRow::schema(),
        GenerationRow::schema(),
        generated(),
        decoded(),
        TokenRow::schema(),
        TokenizationRow::schema(),
        SanityCheckRow::schema(),
        MetricRow::schema(),
        VerdictRow::schema(),
        SongMetricRow::schema(),
    ]
}

#[cfg(test)]
mod tests;
