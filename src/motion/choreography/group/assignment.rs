//! Who goes where: the assignment of least cost.

use ndarray::Array2;

/// Returns for every row the column that it takes, such that `Σᵢ cost[i, column(i)]` is least; shape
/// `[n, n]`.
///
/// One row after another is added along the shortest augmenting path in the costs `cost[i, j] - uᵢ - vⱼ`,
/// `u` and `v` the dual prices; O(n³). Sources: Kuhn, The Hungarian method for the assignment problem,
/// 1955; Jonker and Volgenant, A shortest augmenting path algorithm for dense and sparse linear assignment
/// problems, 1987.
///
/// # Panics
/// When the costs are not square.
pub fn least_cost_assignment(cost: &Array2<f64>) -> Vec<usize> {
    assert!(cost.is_square(), "costs have shape {:?}", cost.dim());
    let n = cost.nrows();
    // Column n stands for "no column yet"; the row that is being added holds it.
    let (mut row_price, mut column_price) = (vec![0.0; n], vec![0.0; n + 1]);
    let mut row_of: Vec<Option<usize>> = vec![None; n + 1];
    for added in 0..n {
        row_of[n] = Some(added);
        let mut from = vec![n; n];
        let mut shortest = vec![f64::INFINITY; n];
        let mut is_reached = vec![false; n + 1];
        let mut here = n;
        while let Some(row) = row_of[here] {
            is_reached[here] = true;
            let (mut step, mut next) = (f64::INFINITY, here);
            for j in (0..n).filter(|&j| !is_reached[j]) {
                let reduced = cost[[row, j]] - row_price[row] - column_price[j];
                if reduced < shortest[j] {
                    (shortest[j], from[j]) = (reduced, here);
                }
                if shortest[j] < step {
                    (step, next) = (shortest[j], j);
                }
            }
            for j in 0..=n {
                match row_of[j] {
                    Some(row) if is_reached[j] => {
                        row_price[row] += step;
                        column_price[j] -= step;
                    }
                    _ if j < n => shortest[j] -= step,
                    _ => {}
                }
            }
            here = next;
        }
        while here != n {
            row_of[here] = row_of[from[here]];
            here = from[here];
        }
    }
    let mut column_of = vec![0; n];
    for (j, row) in row_of[..n].iter().enumerate() {
        column_of[row.expect("invariant: every column has a row when all rows are added")] = j;
    }
    column_of
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::chance::Chance;

    /// Least cost over all permutations of the rows from `row` on.
    fn least_by_trial(cost: &Array2<f64>, row: usize, taken: &mut Vec<bool>) -> f64 {
        if row == cost.nrows() {
            return 0.0;
        }
        let mut least = f64::INFINITY;
        for j in 0..cost.ncols() {
            if !taken[j] {
                taken[j] = true;
                least = least.min(cost[[row, j]] + least_by_trial(cost, row + 1, taken));
                taken[j] = false;
            }
        }
        least
    }

    #[test]
    fn no_permutation_costs_less() {
        let mut chance = Chance::new(5, 0);
        for n in [1, 2, 3, 5, 7] {
            for _ in 0..40 {
                // Whole numbers, so that ties occur and sums are exact.
                let cost = Array2::from_shape_fn((n, n), |_| chance.below(12) as f64 - 3.0);
                let found = least_cost_assignment(&cost);
                let mut columns = found.clone();
                columns.sort_unstable();
                assert_eq!(columns, (0..n).collect::<Vec<_>>());
                let total: f64 = found.iter().enumerate().map(|(i, &j)| cost[[i, j]]).sum();
                assert_eq!(total, least_by_trial(&cost, 0, &mut vec![false; n]), "{cost:?}");
            }
        }
        assert_eq!(least_cost_assignment(&Array2::zeros((0, 0))), Vec::<usize>::new());
    }
}
