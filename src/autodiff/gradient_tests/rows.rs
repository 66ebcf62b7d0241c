//! Rows of tables: the nearest, and those of a fixed table.

use super::*;

#[test]
fn the_nearest_row_is_told_and_its_gradient_goes_straight_through() {
    let specs: [(&str, &[usize], Role); 1] = [("codes", &[4, 2], Role::Code)];
    let (p, ids) = parameters(&specs);
    let mut p = p;
    let plan = Arc::clone(p.plan());
    // The last is as near to the third row of x as the one before it.
    let codes = [1.0, 0.0, -1.0, 0.0, 0.5, 0.5, 0.5, 0.7];
    plan.pack(ids[0], &codes, p.all_mut());
    let arena = Arena::default();
    let mut tape = Tape::new(&p, &arena, None);
    let x = tape.input(&[3, 2], &[0.9, 0.2, -1.0, 0.1, 0.4, 0.6]);
    let index = tape.nearest_row(&x, ids[0]).expect("shapes fit");
    assert_eq!((index.shape(), index.data()), (&[3][..], &[0.0, 1.0, 2.0][..]));
    let rows = tape.embedding(ids[0], &index).expect("within the table");
    let y = tape.straight_through(&x, &rows).expect("shapes fit");
    assert_eq!(y.data(), [1.0, 0.0, -1.0, 0.0, 0.5, 0.5]);
    let weights = tape.constant(&[3, 2], &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
    let scalar = probe(&mut tape, &y, &weights).expect("shapes fit");
    let mut gradients = Gradients::new(&p);
    let found = tape.backward(scalar, &mut gradients).expect("finite");
    assert_eq!(found.of(&x).expect("a gradient").data(), [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
    assert_eq!(gradients.unpacked(ids[0]), [0.0; 8], "codes are not learned by gradients");
}

#[test]
fn the_nearest_row_is_that_of_the_definition_in_any_width() {
    for channels in [1, 3, 16, 37] {
        let (n, rows) = (23, 11);
        let specs: [(&str, &[usize], Role); 1] = [("codes", &[rows, channels], Role::Code)];
        let (p, ids) = parameters(&specs);
        let arena = Arena::default();
        let mut eager = Eager::new(&p, &arena);
        let values = numbers(n * channels, 3);
        let x = eager.input(&[n, channels], &values);
        let index = eager.nearest_row(&x, ids[0]).expect("shapes fit");
        let codes = p.unpacked(ids[0]);
        for (x, &found) in values.chunks(channels).zip(index.data()) {
            let distance = |k: usize| -> f64 {
                let code = &codes[k * channels..][..channels];
                x.iter().zip(code).map(|(a, b)| (a - b).powi(2)).sum()
            };
            let mut wanted = 0;
            for k in 1..rows {
                if distance(k) < distance(wanted) {
                    wanted = k;
                }
            }
            assert_eq!(found, wanted as f64, "{channels} channels");
        }
    }
}

#[test]
fn rows_of_other_widths_are_refused() {
    let specs: [(&str, &[usize], Role); 2] =
        [("codes", &[4, 3], Role::Code), ("vector", &[3], Role::Vector)];
    let (p, ids) = parameters(&specs);
    let arena = Arena::default();
    let mut g = Eager::new(&p, &arena);
    let x = g.input(&[2, 5, 2], &[0.0; 20]);
    assert_eq!(
        g.nearest_row(&x, ids[0]).expect_err("another width").to_string(),
        "nearest_row: input has 2 channels, codes expects 3"
    );
    assert_eq!(
        g.nearest_row(&x, ids[1]).expect_err("no table").to_string(),
        "nearest_row: vector has shape [3], expected [rows, channels]"
    );
    let y = g.input(&[2, 5, 1], &[0.0; 10]);
    assert_eq!(
        g.straight_through(&x, &y).expect_err("another shape").to_string(),
        "straight_through: value has shape [2, 5, 1], input [2, 5, 2]"
    );
}

#[test]
fn a_fixed_table_gives_its_rows() {
    let p = none();
    let arena = Arena::default();
    let mut eager = Eager::new(&p, &arena);
    let table = Arc::new(Array2::from_shape_fn((4, 3), |(i, j)| (10 * i + j) as f64));
    let index = eager.input(&[2], &[3.0, 1.0]);
    let y = eager.gather(&table, &index).expect("within the table");
    assert_eq!((y.shape(), y.data()), (&[2, 3][..], &[30.0, 31.0, 32.0, 10.0, 11.0, 12.0][..]));
}

#[test]
fn the_first_channels_are_turned_by_the_formula_and_the_others_are_left() {
    let (batch, frames, channels) = (2, 5, 79);
    let (p, arena) = (none(), Arena::default());
    let mut g = Eager::new(&p, &arena);
    let values = numbers(batch * frames * channels, 4);
    let x = g.input(&[batch, frames, channels], &values);
    // Heads of 38 channels: two runs of 16, and pairs behind them.
    let (heads, dim) = (2, 38);
    let y = g.rotary_first(&x, heads, [heads * dim, channels]).expect("shapes fit");
    for (row, (y, x)) in
        y.data().chunks_exact(channels).zip(values.chunks_exact(channels)).enumerate()
    {
        let frame = (row % frames) as f64;
        for head in 0..heads {
            for pair in 0..dim / 2 {
                let angle = frame * 10_000_f64.powf(-2.0 * pair as f64 / dim as f64);
                let (at, (sin, cos)) = (head * dim + 2 * pair, angle.sin_cos());
                let wanted = [x[at] * cos - x[at + 1] * sin, x[at] * sin + x[at + 1] * cos];
                for (i, wanted) in wanted.into_iter().enumerate() {
                    let found = y[at + i];
                    assert!((found - wanted).abs() < 1e-14, "row {row}, {at}: {found}, {wanted}");
                }
            }
        }
        assert_eq!(y[heads * dim..], x[heads * dim..], "row {row}");
    }
    check(&[input(&[2, 3, 39], 1)], &p, |g, x| g.rotary_first(&x[0], 1, [36, 39]));
    assert_eq!(
        g.rotary_first(&x, 2, [80, channels]).expect_err("too many").to_string(),
        "rotary: input has 79 channels, 80 are turned"
    );
}
