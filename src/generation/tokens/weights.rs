//! The weights of a model of tokens, read back out of its files.

use super::card::TokensCard;
use crate::autodiff::Parameters;
use crate::generation::card::ModelFileName;
use crate::model::{Parameter, ParameterList, Planner, Tokenizer};
use crate::onnx::{Model, OnnxError, values_of};

/// The files that hold the weights of a tokenizer, with the beginning of the names that lie in each.
const OF_TOKENIZER: [(&str, ModelFileName); 5] = [
    ("encoder.", ModelFileName::Encoder),
    ("codebook", ModelFileName::Encoder),
    ("decoder.", ModelFileName::Signal),
    ("draft.", ModelFileName::Denoiser),
    ("denoiser.", ModelFileName::Denoiser),
];

/// Returns the parameters of the tokenizer and of the planner; `read` gives a file and what messages call it.
///
/// # Errors
/// Errors of `read`, and a file that lacks a weight or has one of another size.
pub fn tokens_parameters<E: From<OnnxError>>(
    card: &TokensCard,
    read: impl Fn(ModelFileName) -> Result<(Model, String), E>,
) -> Result<(Parameters<f32>, Parameters<f32>), E> {
    let mut files = Vec::new();
    for name in [
        ModelFileName::Encoder,
        ModelFileName::Signal,
        ModelFileName::Denoiser,
        ModelFileName::Planner,
    ] {
        files.push((name, read(name)?));
    }
    let values = |file: ModelFileName, parameter: &Parameter| {
        let found = files.iter().find(|(name, _)| *name == file);
        let (_, (model, place)) = found.expect("invariant: every file of the family was read");
        values_of(model, parameter, place)
    };
    let file_of = |parameter: &Parameter| {
        let found = OF_TOKENIZER.iter().find(|(start, _)| parameter.name.starts_with(start));
        found.map_or(ModelFileName::Encoder, |(_, file)| *file)
    };
    let parameters_of =
        |list: ParameterList, file_of: &(dyn Fn(&Parameter) -> ModelFileName + Sync)| {
            // Looked up first, since filling cannot fail.
            for (_, parameter) in list.iter() {
                values(file_of(parameter), parameter)?;
            }
            Ok::<_, OnnxError>(Parameters::from_fn(list, |parameter| {
                values(file_of(parameter), parameter).expect("looked up before")
            }))
        };
    let tokenizer = parameters_of(Tokenizer::new(&card.tokens).1, &file_of)?;
    let planner = parameters_of(Planner::new(&card.planner).1, &|_| ModelFileName::Planner)?;
    Ok((tokenizer, planner))
}
