//! The models that ship with the program: `models/pretrained` for a soloist, `models/group` for groups.

use bytes::Bytes;

/// A model within the program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ShippedModel {
    /// Of the family `unet`, used where no model is named.
    Soloist,
    /// Of the family `group`, used where no model is named and dancers or their consistency are.
    Group,
}

impl ShippedModel {
    /// Every model that ships.
    pub const ALL: [Self; 2] = [Self::Soloist, Self::Group];

    /// Returns its name, under which flags and tables know it.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Soloist => "pretrained",
            Self::Group => "group",
        }
    }

    /// Returns the model of a name; none for another name.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|model| model.name() == name)
    }

    /// Returns the name in messages.
    pub const fn place(self) -> &'static str {
        match self {
            Self::Soloist => "the model of the program",
            Self::Group => "the model of groups of the program",
        }
    }

    /// Returns a file of the model; none where the program was built without it.
    #[cfg(feature = "pretrained")]
    pub fn file(self, name: &str) -> Option<Bytes> {
        use crate::generation::file_names;
        // The folders of `make pretrained`, their files as export writes them.
        macro_rules! file {
            ($path:literal) => {
                Bytes::from_static(include_bytes!(concat!(
                    env!("CARGO_MANIFEST_DIR"),
                    "/models/",
                    $path
                )))
            };
        }
        match (self, name) {
            (Self::Soloist, file_names::CARD) => Some(file!("pretrained/model.json")),
            (Self::Soloist, file_names::UNET) => Some(file!("pretrained/unet.onnx")),
            (Self::Soloist, file_names::DECODER) => Some(file!("pretrained/decoder.onnx")),
            (Self::Group, file_names::CARD) => Some(file!("group/model.json")),
            (Self::Group, file_names::DENOISER) => Some(file!("group/denoiser.onnx")),
            (Self::Group, file_names::SCORE) => Some(file!("group/score.onnx")),
            _ => None,
        }
    }

    /// Returns a file of the model; none where the program was built without it.
    #[cfg(not(feature = "pretrained"))]
    pub fn file(self, _name: &str) -> Option<Bytes> {
        None
    }
}

#[cfg(all(test, feature = "pretrained"))]
mod tests {
    use super::*;
    use crate::generation::{FamilyCard as _, GroupCard, file_names};

    /// What a small model of groups may take within the executables, bytes.
    const MOST_BYTES: usize = 8_000_000;

    #[test]
    fn the_model_of_groups_is_whole_and_small() {
        let file = |name: &str| ShippedModel::Group.file(name).expect(name);
        let card = GroupCard::read(&file(file_names::CARD), "card").expect("a card of groups");
        assert_eq!(card.name, ShippedModel::Group.name());
        assert_eq!(card.precision, crate::onnx::Storage::Fp16);
        assert!(card.provenance.learned_from.is_some(), "evaluate asks what it learned from");
        assert_eq!(card.files.len(), 2);
        let mut n_bytes = file(file_names::CARD).len();
        for entry in &card.files {
            let bytes = file(entry.name.name());
            assert_eq!(bytes.len() as u64, entry.n_bytes, "{}", entry.name);
            assert_eq!(crate::stages::model_files::sha256(&bytes), entry.sha256, "{}", entry.name);
            n_bytes += bytes.len();
        }
        assert!(n_bytes <= MOST_BYTES, "{n_bytes} bytes");
    }
}
