//! A codebook against a transcript of fifty updates, `tests/golden/training/codebook.py`.

use motiongen::autodiff::{Arena, Eager, Element, Parameters};
use motiongen::model::{Graph as _, Init, ParameterList, Role, Scope};
use motiongen::training::{Codebook, CodebookConfig};

use crate::engine::golden::{Golden, assert_near, given};

const ROWS: usize = 23;
const LATENTS: usize = 37;
const WIDTH: usize = 5;
const SHRINKS_AT: usize = 30;
const KEPT: [usize; 6] = [0, 1, 9, 29, 30, 49];

fn latents<E: Element>(update: usize) -> Vec<E> {
    let factor = E::from_f64(if update < SHRINKS_AT { 1.0 } else { 0.25 });
    let u: Vec<E> = given(&format!("codebook.latents.{update}"), LATENTS * WIDTH);
    u.into_iter().map(|u| u * factor).collect()
}

fn candidates<E: Element>(latents: &[E], update: usize) -> Vec<E> {
    let row = |k: usize| &latents[(7 * k + 3 * update) % LATENTS * WIDTH..][..WIDTH];
    (0..ROWS).flat_map(row).copied().collect()
}

/// Returns the nearest code of each latent, as a network says.
fn nearest<E: Element>(codes: &[E], latents: &[E]) -> Vec<usize> {
    let mut list = ParameterList::default();
    let id = Scope::root(&mut list).parameter("codes", &[ROWS, WIDTH], Init::Zeros, Role::Code);
    let parameters = Parameters::from_fn(list, |_| codes.to_vec());
    let arena = Arena::default();
    let mut g = Eager::new(&parameters, &arena);
    let x = g.input(&[LATENTS, WIDTH], latents);
    let index = g.nearest_row(&x, id).expect("shapes fit");
    index.data().iter().map(|k| k.to_f64() as usize).collect()
}

fn check<E: Element>(tolerance: f64) {
    let golden = Golden::open_in("training", "codebook.safetensors");
    let mut codebook = Codebook::<E>::new(&CodebookConfig::default(), ROWS, WIDTH);
    let mut codes = vec![E::ZERO; ROWS * WIDTH];
    assert!(!codebook.is_begun());
    codebook.begin(&mut codes, &candidates(&latents::<E>(0), 0));
    assert!(codebook.is_begun());
    let (tokens, replaced) = (golden.values("tokens"), golden.values("replaced"));
    let n_updates = tokens.len() / LATENTS;
    assert_eq!(n_updates, 50);
    assert!(replaced.iter().sum::<f64>() > 20.0, "the transcript has codes that die");
    let mut kept = KEPT.iter().enumerate().peekable();
    for update in 0..n_updates {
        let h = latents::<E>(update);
        let wanted: Vec<usize> =
            tokens[update * LATENTS..][..LATENTS].iter().map(|&k| k as usize).collect();
        assert_eq!(nearest(&codes, &h), wanted, "update {update}");
        let drawn = candidates(&h, update);
        codebook.update(&mut codes, &h, &wanted, &drawn);
        for k in 0..ROWS {
            let is_replaced = codes[k * WIDTH..][..WIDTH] == drawn[k * WIDTH..][..WIDTH];
            // A row that began at a latent of the first batch, and stands for it alone, stays there.
            let may_be_both = update == 0;
            let wanted = replaced[update * ROWS + k] == 1.0;
            assert!(is_replaced == wanted || may_be_both && !wanted, "update {update}, row {k}");
        }
        if let Some((i, _)) = kept.next_if(|(_, kept)| **kept == update) {
            let rows = &golden.values("codebook")[i * codes.len()..][..codes.len()];
            assert_near(&format!("codebook after {update}"), &codes, rows, tolerance);
            let usage = &golden.values("usage")[i * ROWS..][..ROWS];
            assert_near(&format!("usage after {update}"), codebook.usage(), usage, tolerance);
        }
    }
    assert_eq!(kept.next(), None, "every update that is kept was compared");
}

#[test]
fn fifty_updates_are_numpys() {
    check::<f64>(1e-12);
    check::<f32>(1e-5);
}
