//! One broken phrase: how to make it, and what the table of failures must say of it.

use std::path::Path;

use crate::support::write;

pub struct Case {
    /// The phrase, as the table names it.
    pub id: String,
    pub kind: &'static str,
    /// The whole sentence; `{source}` stands for the source's folder.
    pub message: String,
    /// The file or folder at fault, below the source.
    pub at_fault: String,
    make: Make,
}

enum Make {
    Files(Vec<(String, Vec<u8>)>),
    With(fn(&Path)),
}

impl Case {
    /// A phrase of `motion/ID/trajectory.npy` alone.
    pub fn npy(id: &str, bytes: Vec<u8>, kind: &'static str, sentence: &str) -> Self {
        Self::file(id, &format!("motion/{id}/trajectory.npy"), bytes, kind, sentence)
    }

    /// A phrase of `motion/ID/motion.bvh` alone.
    pub fn bvh(id: &str, bytes: impl Into<Vec<u8>>, kind: &'static str, sentence: &str) -> Self {
        Self::file(id, &format!("motion/{id}/motion.bvh"), bytes, kind, sentence)
    }

    /// A phrase of `audio_features/ID/features.npz` alone.
    pub fn npz(id: &str, bytes: Vec<u8>, kind: &'static str, sentence: &str) -> Self {
        Self::file(id, &format!("audio_features/{id}/features.npz"), bytes, kind, sentence)
    }

    /// A phrase of one file, of which the message is `path: sentence`, or just the sentence when
    /// that names the path.
    pub fn file(
        id: &str,
        path: &str,
        bytes: impl Into<Vec<u8>>,
        kind: &'static str,
        sentence: &str,
    ) -> Self {
        Self::files(id, [(path, bytes.into())], path, kind, sentence)
    }

    /// A phrase of several files, of which one is at fault.
    pub fn files(
        id: &str,
        files: impl IntoIterator<Item = (impl Into<String>, Vec<u8>)>,
        at_fault: &str,
        kind: &'static str,
        sentence: &str,
    ) -> Self {
        let files = files.into_iter().map(|(path, bytes)| (path.into(), bytes)).collect();
        let names_path = sentence.contains("{path}") || sentence.contains('/');
        let message = if names_path {
            sentence.replace("{path}", at_fault)
        } else {
            format!("{at_fault}: {sentence}")
        };
        Self {
            id: id.to_owned(),
            kind,
            message,
            at_fault: at_fault.to_owned(),
            make: Make::Files(files),
        }
    }

    /// Something that takes more than writing files, made in the source's folder.
    pub fn tree(
        id: &str,
        at_fault: &str,
        make: fn(&Path),
        kind: &'static str,
        sentence: &str,
    ) -> Self {
        Self {
            id: id.to_owned(),
            kind,
            message: sentence.replace("{path}", at_fault),
            at_fault: at_fault.to_owned(),
            make: Make::With(make),
        }
    }

    pub fn make(&self, source: &Path) {
        match &self.make {
            Make::Files(files) => {
                for (path, bytes) in files {
                    write(&source.join(path), bytes);
                }
            }
            Make::With(make) => make(source),
        }
    }
}
