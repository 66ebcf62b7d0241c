//! The three products of a layer against their definitions, summed in f64.

use super::*;
use crate::autodiff::arena::Arena;
use crate::autodiff::element::Element;

/// Numbers in \[-1, 1) that look random and are always the same.
fn numbers(n: usize, seed: u64) -> Vec<f64> {
    let mut x = seed;
    let mut next = || {
        x = x.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (x >> 40) as f64 / f64::from(1 << 23) - 1.0
    };
    (0..n).map(|_| next()).collect()
}

fn single(x: &[f64]) -> Vec<f32> {
    x.iter().map(|&x| x as f32).collect()
}

/// The largest difference must be below 2e-6 of the largest value: sums of up to 1,500 products in
/// f32, whose rounding grows with the root of their number.
fn assert_near(got: &[f32], wanted: &[f64], what: &str) {
    let scale = wanted.iter().fold(0.0_f64, |a, x| a.max(x.abs()));
    for (i, (&got, &wanted)) in got.iter().zip(wanted).enumerate() {
        let difference = (f64::from(got) - wanted).abs();
        assert!(difference <= 2e-6 * scale, "{what} at {i}: got {got}, wanted {wanted}");
    }
}

#[test]
fn products_are_those_of_the_definition() {
    let shape = |batch, frames, taps, stride, padding, dilation| Conv {
        batch,
        frames,
        taps,
        stride,
        padding,
        dilation,
    };
    for (conv, channels, n) in [
        (shape(2, 13, 3, 1, 1, 1), 25, 70),
        (shape(3, 9, 3, 2, 1, 1), 19, 33),
        (shape(1, 11, 5, 1, 6, 3), 16, 48),
        (shape(1, 7, 3, 1, 1, 1), 400, 17),
        (shape(2, 10, 4, 2, 1, 1), 5, 3),
        (Conv::linear(37), 21, 65),
        // Rows that pass in blocks.
        (Conv::linear(1100), 70, 200),
        // More rows than the turned product takes, and a gradient that is summed in two blocks.
        (shape(3, 43, 3, 1, 1, 1), 25, 70),
        (shape(4, 90, 3, 2, 1, 1), 19, 33),
        (shape(2, 700, 3, 1, 1, 1), 17, 18),
    ] {
        let what = format!("{conv:?}, {channels} to {n}");
        let k = conv.taps * channels;
        let x = numbers(conv.in_rows() * channels, 1);
        let w = numbers(n * k, 2);
        let bias = numbers(n, 3);
        let dy = numbers(conv.out_rows() * n, 4);
        let mut y = vec![0.0; conv.out_rows() * n];
        let mut dx = vec![0.0; x.len()];
        let mut dw = vec![0.0; w.len()];
        let mut db = vec![0.0; n];
        for b in 0..conv.batch {
            for t in 0..conv.out_frames() {
                let row = b * conv.out_frames() + t;
                for o in 0..n {
                    y[row * n + o] += bias[o];
                    db[o] += dy[row * n + o];
                    for tap in 0..conv.taps {
                        let at = (t * conv.stride + tap * conv.dilation).wrapping_sub(conv.padding);
                        if at >= conv.frames {
                            continue;
                        }
                        for c in 0..channels {
                            let i = (b * conv.frames + at) * channels + c;
                            let j = (o * channels + c) * conv.taps + tap;
                            y[row * n + o] += w[j] * x[i];
                            dx[i] += w[j] * dy[row * n + o];
                            dw[j] += x[i] * dy[row * n + o];
                        }
                    }
                }
            }
        }
        let (x, w, bias, dy) = (single(&x), single(&w), single(&bias), single(&dy));
        let mut packed = vec![0.0; packed_len(n, k)];
        pack_weight(&w, n, channels, conv.taps, &mut packed);

        let mut got = vec![f32::NAN; y.len()];
        product(&x, channels, &conv.forward(), &packed, Some(&bias), &mut got, n);
        assert_near(&got, &y, &format!("output, {what}"));

        let mut got = vec![f32::NAN; dx.len()];
        input_gradient(&dy, n, &conv, &packed, &mut got, channels, &Arena::default());
        assert_near(&got, &dx, &format!("input's gradient, {what}"));

        // Twice, the second time added: the result doubles.
        let mut panels = vec![f32::NAN; packed.len()];
        let mut d_bias = vec![f32::NAN; n];
        let arena = Arena::default();
        for add in [false, true] {
            let (panels, d_bias) = (&mut panels, Some(&mut d_bias[..]));
            let add = [add, add];
            weight_gradient(&x, channels, &dy, n, &conv, panels, d_bias, add, &arena);
        }
        let mut got = vec![0.0; dw.len()];
        unpack_weight(&panels, n, channels, conv.taps, &mut got);
        let doubled = |x: &[f64]| x.iter().map(|x| 2.0 * x).collect::<Vec<_>>();
        assert_near(&got, &doubled(&dw), &format!("weight's gradient, {what}"));
        assert_near(&d_bias, &doubled(&db), &format!("bias's gradient, {what}"));
    }
}

#[test]
fn any_number_of_threads_gives_the_same_bits() {
    let conv = Conv { batch: 2, frames: 31, taps: 3, stride: 1, padding: 1, dilation: 1 };
    let (channels, n) = (40, 150);
    let x = single(&numbers(conv.in_rows() * channels, 1));
    let weight = single(&numbers(packed_len(n, 3 * channels), 2));
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        let mut y = vec![0.0_f32; conv.out_rows() * n];
        let mut dx = vec![0.0_f32; x.len()];
        let mut dw = vec![0.0_f32; weight.len()];
        pool.install(|| {
            product(&x, channels, &conv.forward(), &weight, None, &mut y, n);
            input_gradient(&y, n, &conv, &weight, &mut dx, channels, &Arena::default());
            let arena = Arena::default();
            weight_gradient(&x, channels, &y, n, &conv, &mut dw, None, [false; 2], &arena);
        });
        [y, dx, dw].concat().iter().map(|x| x.to_bits()).collect::<Vec<_>>()
    };
    let one = run(1);
    assert!(run(2) == one, "2 threads");
    assert!(run(4) == one, "4 threads");
}

#[test]
fn rows_in_blocks_give_the_bits_of_one_pass() {
    // Two blocks and a part of one; weights that end within a panel.
    let (rows, channels, n) = (1100, 21, 37);
    assert!(rows > many_rows::block_rows(channels), "one block is no test");
    let (x, dy) = (single(&numbers(rows * channels, 1)), single(&numbers(rows * n, 2)));
    let arena = Arena::default();
    let (mut panels, mut d_bias) = (vec![0.0; packed_len(n, channels)], vec![0.0; n]);
    let conv = Conv::linear(rows);
    for add in [[false; 2], [true; 2]] {
        let d_bias = Some(&mut d_bias[..]);
        weight_gradient(&x, channels, &dy, n, &conv, &mut panels, d_bias, add, &arena);
    }
    let mut got = vec![0.0; n * channels];
    unpack_weight(&panels, n, channels, 1, &mut got);
    let of_bias = |o: usize| (0..rows).fold(0.0_f32, |sum, row| sum + dy[row * n + o]);
    let wanted: Vec<_> = (0..n).map(|o| of_bias(o) + of_bias(o)).collect();
    assert_eq!(d_bias, wanted, "bias");
    for o in 0..n {
        for c in 0..channels {
            let product = |row: usize| (x[row * channels + c], dy[row * n + o]);
            let sum = (0..rows).map(product).fold(0.0_f32, |sum, (x, dy)| match level() {
                Level::Portable => sum.fused(x, dy),
                _ => x.mul_add(dy, sum),
            });
            assert_eq!(got[o * channels + c], sum + sum, "output {o}, channel {c}");
        }
    }
}

#[test]
fn small_products_are_those_of_the_definition_with_any_strides() {
    let [m, k, n] = [13, 7, 53];
    let (a, b) = (numbers(m * k, 1), numbers(k * n, 2));
    let mut wanted = vec![0.0; m * n];
    for i in 0..m {
        for j in 0..n {
            wanted[i * n + j] = 0.5 * (0..k).map(|p| a[p * m + i] * b[p * n + j]).sum::<f64>();
        }
    }
    let (a, b) = (single(&a), single(&b));
    let mut got = vec![f32::NAN; m * n];
    let a = Matrix { data: &a, strides: [m, 1] }.t();
    let b = Matrix { data: &b, strides: [n, 1] };
    let c = MatrixMut { data: &mut got, row_stride: n };
    matmul([m, k, n], 0.5, a, b, c, false, &mut Vec::new());
    assert_near(&got, &wanted, "α A B");
}

/// Runs one tile with a form of the kernel, and returns what it wrote.
#[cfg(target_arch = "x86_64")]
fn run_form(
    form: unsafe fn(&Tile<f32>),
    n_rows: usize,
    n_panels: usize,
    [add, goes_on]: [bool; 2],
) -> Vec<f32> {
    let (k, segments) = (37, 3);
    let n_columns = if goes_on { 16 * n_panels } else { 16 * n_panels - 5 };
    let a = single(&numbers(8 * segments * k, 1));
    let b = single(&numbers(n_panels * segments * k * PANEL, 2));
    let mut c = single(&numbers(n_rows * n_columns, 3));
    let at = c.as_mut_ptr();
    let row = |r: usize| r.min(n_rows - 1);
    let tile = Tile {
        rows: std::array::from_fn(|r| a[row(r) * segments * k..].as_ptr()),
        n_rows,
        step: 1,
        k,
        segments,
        a_segment: k,
        b: b.as_ptr(),
        b_panel: segments * k * PANEL,
        b_segment: k * PANEL,
        n_panels,
        c: std::array::from_fn(|r| at.wrapping_add(row(r) * n_columns)),
        c_panel: PANEL,
        n_columns,
        add,
        goes_on,
        stream: false,
    };
    // SAFETY: rows, panels and output have the sizes that the tile states, and the caller found the
    // form's instructions.
    unsafe { form(&tile) };
    c
}

#[cfg(target_arch = "x86_64")]
#[test]
fn every_form_of_the_tile_gives_what_the_portable_one_gives() {
    let avx2 = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
    let avx512 = avx2 && is_x86_feature_detected!("avx512f");
    for n_rows in 1..=8 {
        for n_panels in 1..=3 {
            for add in [[false, false], [true, false], [false, true]] {
                let what = format!("{n_rows} rows, {n_panels} panels, added to, goes on: {add:?}");
                let portable = run_form(run_portable, n_rows, n_panels, add);
                let wanted: Vec<_> = portable.iter().map(|&x| f64::from(x)).collect();
                if avx2 {
                    let fused = run_form(x86::run_avx2, n_rows, n_panels, add);
                    assert_near(&fused, &wanted, &what);
                    if avx512 {
                        // Both round once for each product, in the same order.
                        assert_eq!(
                            run_form(x86::run_avx512, n_rows, n_panels, add),
                            fused,
                            "{what}"
                        );
                    }
                }
            }
        }
    }
}
