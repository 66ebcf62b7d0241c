//! The losses of decoded motion, value and gradient.

use motiongen::autodiff::{Arena, Element, Gradients, Parameters, Tape};
use motiongen::model::ParameterList;
use motiongen::motion::{BODY, Normalizer};
use motiongen::training::{TemporalConfig, TemporalLosses, reconstruction, temporal_losses};

use super::given::{open, single};
use crate::engine::golden::{Golden, assert_near};

fn stored_normalizer(golden: &Golden) -> Normalizer {
    let mut normalizer = Normalizer::identity();
    normalizer.centre.copy_from_slice(&single(golden.values("centre")));
    normalizer.scale.copy_from_slice(&single(golden.values("scale")));
    normalizer
}

/// Compares every loss and its gradient.
fn check<E: Element>(tolerance: f64) {
    let golden = open("decoded_losses");
    let normalizer = stored_normalizer(&golden);
    let (motion, mask) = (single(golden.values("motion")), single(golden.values("mask")));
    let config = TemporalConfig {
        phase_weight: 0.5,
        smoothness_weight: 1.5,
        max_step_m: 0.375,
        ..TemporalConfig::reference()
    };
    let parameters = Parameters::<E>::new(ParameterList::default(), 0);
    let arena = Arena::default();
    let names = ["position", "quaternion", "all"].into_iter().chain(TemporalLosses::<()>::NAMES);
    for (i, name) in names.enumerate() {
        let mut tape = Tape::new(&parameters, &arena, None);
        let decoded: Vec<_> = golden.values("decoded").iter().map(|&x| E::from_f64(x)).collect();
        let decoded = tape.input(golden.shape("decoded"), &decoded);
        let found = reconstruction(&mut tape, &normalizer, &decoded, &motion, &mask);
        let found = found.expect("shapes fit");
        let of_time =
            temporal_losses(&mut tape, BODY, &config, &decoded, &mask).expect("shapes fit");
        let all = [&found.position, &found.quaternion, &found.all]
            .into_iter()
            .chain(of_time.all())
            .collect::<Vec<_>>();
        let loss = all[i].clone();
        let wanted = golden.values(&format!("loss/{name}"));
        assert_near(name, loss.data(), wanted, tolerance);
        let mut gradients = Gradients::new(&parameters);
        let found = tape.backward(loss, &mut gradients).expect("finite");
        let gradient = found.of(&decoded).expect("a gradient");
        let wanted = golden.values(&format!("grad/{name}"));
        let what = format!("gradient of {name}");
        assert_near(&what, gradient.data(), wanted, tolerance);
    }
}

#[test]
fn every_loss_of_decoded_motion_and_its_gradient_are_pytorchs() {
    // Only the order of sums differs: the normalizer's numbers are exact in f32. 1e-4 is allowed.
    check::<f64>(1e-9);
    check::<f32>(1e-4);
}
