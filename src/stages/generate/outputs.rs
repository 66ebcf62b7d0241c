//! The files that a motion is written into.

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail};
use ndarray::{ArrayView3, Axis};

use crate::motion::Trajectory;
use crate::motion::exchange::{
    write_bvh, write_csv, write_glb, write_group_csv, write_group_glb, write_group_npy, write_npy,
};
use crate::plot::{self, GroupPlot, MOTION_WIDTH_PX, MotionPanel, MotionPlot};
use crate::store::{PartWriter, replace_file, tables, temporary_beside, write_file};
use crate::training::TemporalConfig;
use crate::view::{Audio, View, ViewSample, mime_of, page};

/// What a motion is written as.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, clap::ValueEnum)]
pub enum MotionFormat {
    /// NumPy, [frames, 25].
    Npy,
    /// One line for each frame.
    Csv,
    /// A table of one file, as in the store.
    Parquet,
    /// Motion capture of a single joint.
    Bvh,
    /// glTF 2.0 with a body that moves.
    Glb,
    /// A picture of six panels.
    Png,
    /// The same picture, to be enlarged.
    Svg,
    /// A page that plays music and motion.
    Html,
}

/// What a stream is made of.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum StreamFormat {
    /// A header, then a line for each frame, as in a csv file.
    #[default]
    Csv,
    /// An object for each frame, in a line of its own.
    Ndjson,
}

impl MotionFormat {
    /// What is written unless the user says otherwise.
    pub const DEFAULT: [Self; 4] = [Self::Npy, Self::Glb, Self::Png, Self::Html];

    /// Returns the end of a file's name.
    pub fn extension(self) -> &'static str {
        match self {
            Self::Npy => "npy",
            Self::Csv => "csv",
            Self::Parquet => "parquet",
            Self::Bvh => "bvh",
            Self::Glb => "glb",
            Self::Png => "png",
            Self::Svg => "svg",
            Self::Html => "html",
        }
    }
}

/// A motion and what belongs to it.
pub struct MotionOutput<'a> {
    pub name: &'a str,
    /// Dancer by dancer, \[N, T, 25\].
    pub frames: ArrayView3<'a, f32>,
    pub beats_s: &'a [f64],
    pub audio: &'a Path,
    pub facts: Vec<(String, String)>,
}

/// Writes a motion into a folder in some formats; returns the files.
///
/// # Errors
/// The error of the file system, with the file's name; each file is whole or not there.
pub fn write(
    output: &MotionOutput,
    formats: &[MotionFormat],
    folder: &Path,
) -> anyhow::Result<Vec<PathBuf>> {
    let mut written = Vec::new();
    for &format in formats {
        let path = folder.join(format!("{}.{}", output.name, format.extension()));
        write_as(output, format, &path)
            .with_context(|| format!("while writing {}", path.display()))?;
        written.push(path);
    }
    Ok(written)
}

fn write_as(output: &MotionOutput, format: MotionFormat, path: &Path) -> anyhow::Result<()> {
    if output.frames.len_of(Axis(0)) != 1 {
        return write_group_as(output, format, path);
    }
    let frames = output.frames.index_axis(Axis(0), 0);
    let to_file = |write: &dyn Fn(&mut dyn Write) -> io::Result<()>| -> anyhow::Result<()> {
        write_file(path, |out| write(out))?;
        Ok(())
    };
    match format {
        MotionFormat::Npy => to_file(&|out| write_npy(frames, out)),
        MotionFormat::Csv => to_file(&|out| write_csv(frames, out)),
        MotionFormat::Bvh => to_file(&|out| write_bvh(frames, out)),
        MotionFormat::Glb => {
            let audio = output.audio.file_name().map(|name| name.to_string_lossy().into_owned());
            to_file(&|out| write_glb(frames, audio.as_deref(), out))
        }
        MotionFormat::Parquet => {
            let file = temporary_beside(path)?;
            let mut writer = PartWriter::new(tables::motion(), file)?;
            writer.write_frames(output.name, frames)?;
            replace_file(path, writer.finish(&[])?.file)?;
            Ok(())
        }
        MotionFormat::Png | MotionFormat::Svg => {
            let motion = Trajectory::new(frames.to_owned())?;
            let figure = MotionPlot {
                title: output.name,
                motion: &motion,
                beat_times_s: output.beats_s,
                first_frame: 0,
                jerk_limit_m_s3: TemporalConfig::default().target_jerk,
            };
            let format =
                if format == MotionFormat::Png { plot::Format::Png } else { plot::Format::Svg };
            let bytes = plot::motion(&figure, &MotionPanel::USUAL, MOTION_WIDTH_PX, format)?.bytes;
            to_file(&|out| out.write_all(&bytes))
        }
        MotionFormat::Html => {
            let text = page(&self::view(output)?);
            to_file(&|out| out.write_all(text.as_bytes()))
        }
    }
}

/// Writes the motion of several dancers.
fn write_group_as(output: &MotionOutput, format: MotionFormat, path: &Path) -> anyhow::Result<()> {
    let group = output.frames;
    let to_file = |write: &dyn Fn(&mut dyn Write) -> io::Result<()>| -> anyhow::Result<()> {
        write_file(path, |out| write(out))?;
        Ok(())
    };
    match format {
        MotionFormat::Npy => to_file(&|out| write_group_npy(group, out)),
        MotionFormat::Csv => to_file(&|out| write_group_csv(group, out)),
        MotionFormat::Bvh => bail!(
            "bvh holds one dancer, and there are {}; choose glb, npy or csv with --format",
            group.len_of(Axis(0))
        ),
        MotionFormat::Glb => {
            let audio = output.audio.file_name().map(|name| name.to_string_lossy().into_owned());
            to_file(&|out| write_group_glb(group, audio.as_deref(), out))
        }
        MotionFormat::Parquet => {
            let file = temporary_beside(path)?;
            let mut writer = PartWriter::new(tables::motion(), file)?;
            writer.write_group(output.name, group)?;
            replace_file(path, writer.finish(&[])?.file)?;
            Ok(())
        }
        MotionFormat::Png | MotionFormat::Svg => {
            let figure = GroupPlot { title: output.name, group };
            let format =
                if format == MotionFormat::Png { plot::Format::Png } else { plot::Format::Svg };
            let bytes = plot::group(&figure, MOTION_WIDTH_PX, format)?.bytes;
            to_file(&|out| out.write_all(&bytes))
        }
        MotionFormat::Html => {
            let text = page(&self::view(output)?);
            to_file(&|out| out.write_all(text.as_bytes()))
        }
    }
}

fn view(output: &MotionOutput) -> anyhow::Result<View> {
    let bytes = std::fs::read(output.audio)
        .with_context(|| format!("while reading {}", output.audio.display()))?;
    let extension = output.audio.extension().and_then(|e| e.to_str()).unwrap_or_default();
    Ok(View {
        title: output.name.to_owned(),
        samples: vec![ViewSample::of_group(
            output.name.to_owned(),
            output.frames,
            output.facts.clone(),
        )],
        beats_s: output.beats_s.to_vec(),
        audio: Some(Audio { mime: mime_of(extension).to_owned(), bytes }),
    })
}
