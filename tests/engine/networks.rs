//! Whole networks: output, loss and every gradient against PyTorch in f64.

use motiongen::autodiff::op::loss::{Cost, Loss};
use motiongen::autodiff::{
    Arena, Eager, Element, Gradients, Interpreter, Parameters, Tape, Tensor,
};
use motiongen::model::{
    DecoderConfig, Graph, MotionDecoder, Preset, Result, UNet1D, UNetConfig, UNetInputs,
};

use super::golden::{Golden, assert_near, given, parameters, steps};

/// The inputs of a UNet's golden file.
struct Case<'a> {
    golden: &'a Golden,
    config: UNetConfig,
    batch: usize,
    frames: usize,
}

impl Case<'_> {
    fn new<'a>(golden: &'a Golden, config: UNetConfig) -> Case<'a> {
        let &[batch, frames, _] = golden.shape("output") else {
            panic!("[batch, frames, channels]")
        };
        Case { golden, config, batch, frames }
    }

    fn input<E: Element>(&self, name: &str, channels: usize) -> (Vec<usize>, Vec<E>) {
        let shape = vec![self.batch, self.frames, channels];
        (shape, given(&format!("input.{name}"), self.batch * self.frames * channels))
    }

    fn stored<E: Element>(&self, name: &str) -> Option<Vec<E>> {
        let values = self.golden.get(&format!("input/{name}"))?;
        Some(values.iter().map(|&x| E::from_f64(x)).collect())
    }

    fn t<E: Element>(&self) -> Vec<E> {
        self.stored("t").unwrap_or_else(|| steps(self.batch))
    }

    /// Runs the network on inputs that `make` wraps; returns x, audio, style and the output.
    fn run<G: Graph>(
        &self,
        g: &mut G,
        unet: &UNet1D,
        mut make: impl FnMut(&mut G, &[usize], Vec<f64>, bool) -> G::Tensor,
    ) -> Result<(Vec<G::Tensor>, G::Tensor)> {
        let c = &self.config;
        let (shape, values) = self.input("x", c.in_channels);
        let x = make(g, &shape, values, true);
        let (shape, values) = self.input("audio", c.audio_cond_dim);
        let audio = make(g, &shape, values, true);
        let t = make(g, &[self.batch], self.t(), false);
        let drop = self.stored("drop").map(|values| make(g, &[self.batch], values, false));
        let shape = [self.batch, self.frames];
        let mask = self.stored("mask").map(|values| make(g, &shape, values, false));
        let style = (c.style_dim > 0).then(|| {
            let values = given("input.style", self.batch * c.style_dim);
            make(g, &[self.batch, c.style_dim], values, true)
        });
        let inputs = UNetInputs {
            x: &x,
            t: &t,
            audio: &audio,
            drop_audio: drop.as_ref(),
            mask: mask.as_ref(),
            style: style.as_ref(),
        };
        let y = unet.forward(g, inputs)?;
        Ok(([x, audio].into_iter().chain(style).collect(), y))
    }
}

fn single<E: Element>(values: &[f64]) -> Vec<E> {
    values.iter().map(|&x| E::from_f64(x)).collect()
}

/// Compares a UNet in the element's precision; returns the worst error.
fn check<E: Element>(name: &str, config: &UNetConfig, tolerance: f64) -> f64 {
    let golden = Golden::open(&format!("{name}.safetensors"));
    let case = Case::new(&golden, config.clone());
    let (unet, list) = UNet1D::new(config);
    let parameters: Parameters<E> = parameters(list);
    let arena = Arena::default();

    let mut tape = Tape::new(&parameters, &arena, None);
    let (inputs, y) = case
        .run(&mut tape, &unet, |tape, shape, values, differentiate| {
            let values = single(&values);
            if differentiate { tape.input(shape, &values) } else { tape.constant(shape, &values) }
        })
        .expect("shapes fit");
    let mut worst = assert_near("output", y.data(), golden.values("output"), tolerance);

    let (shape, target) = case.input::<E>("target", config.out_channels);
    let target = tape.constant(&shape, &target);
    let loss = tape.apply(Loss::new(Cost::Squared), &[&y, &target]).expect("shapes fit");
    worst = worst.max(assert_near("loss", loss.data(), golden.values("loss"), tolerance));
    drop(y);
    let mut gradients = Gradients::new(&parameters);
    let found = tape.backward(loss, &mut gradients).expect("finite");
    for (name, input) in ["x", "audio", "style"].iter().zip(&inputs) {
        if let Some(wanted) = golden.get(&format!("grad.input/{name}")) {
            let got = found.of(input).expect("a gradient");
            let error = assert_near(&format!("gradient of {name}"), got.data(), wanted, tolerance);
            worst = worst.max(error);
        }
    }
    let places = parameters.list().by_name();
    assert_eq!(places.len(), golden.parameters.len(), "parameters by name");
    gradients.all();
    let gradients = std::cell::RefCell::new(gradients);
    let gradient_of = |name: &str| {
        let id = places[name];
        gradients.borrow_mut().unpacked(id).into_iter().map(Element::to_f64).collect()
    };
    worst = worst.max(golden.compare("grad", 0, tolerance, gradient_of));

    let mut eager = Eager::new(&parameters, &arena);
    let (_, again): (Vec<Tensor<E>>, _) = case
        .run(&mut eager, &unet, |eager, shape, values, _| eager.input(shape, &single(&values)))
        .expect("shapes fit");
    assert_near("eager output", again.data(), golden.values("output"), tolerance);
    worst
}

/// In f32 1e-4 is allowed; in f64, where only the order of sums differs, 1e-9 would show any
/// formula that is not PyTorch's.
const SINGLE: f64 = 1e-4;
const DOUBLE: f64 = 1e-9;

#[test]
fn tiny_with_padding_masks_and_dropped_music_is_pytorchs() {
    let config = Preset::Tiny.config();
    check::<f64>("unet_tiny", &config, DOUBLE);
    check::<f32>("unet_tiny", &config, SINGLE);
}

#[test]
fn checkpoints_change_no_gradient() {
    let config = UNetConfig { use_checkpoint: true, ..Preset::Tiny.config() };
    check::<f64>("unet_tiny", &config, DOUBLE);
}

#[test]
fn style_added_time_channels_per_head_and_music_by_attention_alone_are_pytorchs() {
    let config = UNetConfig {
        widths: vec![40, 48, 80],
        add_audio: false,
        style_dim: 8,
        use_scale_shift_norm: false,
        num_head_channels: Some(8),
        ..Preset::Tiny.config()
    };
    check::<f64>("unet_tiny_options", &config, DOUBLE);
    check::<f32>("unet_tiny_options", &config, SINGLE);
}

#[test]
fn small_is_pytorchs() {
    check::<f64>("unet_small", &Preset::Small.config(), DOUBLE);
    check::<f32>("unet_small", &Preset::Small.config(), SINGLE);
}

#[test]
fn a_step_of_base_is_pytorchs() {
    check::<f32>("unet_base", &Preset::Base.config(), SINGLE);
}

fn check_decoder<E: Element>(tolerance: f64) {
    let golden = Golden::open("decoder.safetensors");
    let &[batch, frames, channels] = golden.shape("output") else { panic!("three axes") };
    let shape = [batch, frames, channels];
    let n = batch * frames * channels;
    let (decoder, list) = MotionDecoder::new(&DecoderConfig::default());
    let n_parameters = list.n_elements();
    assert!((2_110_000..2_130_000).contains(&n_parameters), "{n_parameters}");
    let parameters: Parameters<E> = parameters(list);
    let arena = Arena::default();
    let mut tape = Tape::new(&parameters, &arena, None);
    let x = tape.input(&shape, &given("input.x", n));
    let y = decoder.forward(&mut tape, &x).expect("shapes fit");
    assert_near("output", y.data(), golden.values("output"), tolerance);
    let target = tape.constant(&shape, &given("input.target", n));
    let loss = tape.apply(Loss::new(Cost::Squared), &[&y, &target]).expect("shapes fit");
    let mut gradients = Gradients::new(&parameters);
    let found = tape.backward(loss, &mut gradients).expect("finite");
    let dx = found.of(&x).expect("a gradient");
    assert_near("gradient of x", dx.data(), golden.values("grad.input/x"), tolerance);
    let places = parameters.list().by_name();
    let gradients = std::cell::RefCell::new(gradients);
    golden.compare("grad", 0, tolerance, |name| {
        gradients.borrow_mut().unpacked(places[name]).into_iter().map(Element::to_f64).collect()
    });
}

#[test]
fn the_decoder_is_pytorchs() {
    check_decoder::<f64>(DOUBLE);
    check_decoder::<f32>(SINGLE);
}
