//! Who is who: the assignment of least cost.

use ndarray::ArrayView2;
use pathfinding::matrix::Matrix;
use pathfinding::prelude::kuhn_munkres_min;

/// Steps between no cost and the highest one; costs that differ by less count as equal.
const N_STEPS: f64 = (1_u64 << 40) as f64;

/// Returns, for every row of a matrix of costs, `[N, N]`, the column that it is given, each to one row.
///
/// The sum of `cost[i, assigned[i]]` is the least there is, to one part in 2⁴⁰ of the highest cost. Among
/// equal sums fewest rows have a column of another number, so that where nothing speaks for a change
/// nobody is changed. A cost that is not finite counts as twice the highest that is. Source: Munkres,
/// "Algorithms for the Assignment and Transportation Problems", 1957. O(N³).
///
/// # Panics
/// When the matrix is not square.
pub fn assign(cost: ArrayView2<f64>) -> Vec<usize> {
    let (n, n_columns) = cost.dim();
    assert_eq!(n, n_columns, "costs of dancers are square");
    let highest = cost.iter().copied().filter(|x| x.is_finite()).map(f64::abs).fold(0.0, f64::max);
    if n == 0 || (highest == 0.0 && cost.iter().all(|x| x.is_finite())) {
        return (0..n).collect();
    }
    // Whole numbers, of which the least part counts changes: more of them than there are rows are never
    // worth a step.
    let n_parts = n as i64 + 1;
    let weight = |(i, j): (usize, usize)| {
        let share = if !cost[[i, j]].is_finite() {
            2.0
        } else if highest > 0.0 {
            cost[[i, j]] / highest
        } else {
            0.0
        };
        (share * N_STEPS).round() as i64 * n_parts + i64::from(i != j)
    };
    kuhn_munkres_min(&Matrix::from_fn(n, n, weight)).1
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::chance::Chance;
    use ndarray::{Array2, array};

    /// All orders of 0..n.
    fn permutations(n: usize) -> Vec<Vec<usize>> {
        if n == 0 {
            return vec![Vec::new()];
        }
        let with_last = |shorter: Vec<usize>| {
            (0..n).map(move |at| {
                let mut longer = shorter.clone();
                longer.insert(at, n - 1);
                longer
            })
        };
        permutations(n - 1).into_iter().flat_map(with_last).collect()
    }

    fn sum(cost: &Array2<f64>, order: &[usize]) -> f64 {
        order.iter().enumerate().map(|(i, &j)| cost[[i, j]]).sum()
    }

    fn n_changed(order: &[usize]) -> usize {
        order.iter().enumerate().filter(|(i, j)| i != *j).count()
    }

    #[test]
    fn no_order_is_cheaper_than_the_one_that_is_found() {
        let mut chance = Chance::new(11, 0);
        for n in 1..=6 {
            let orders = permutations(n);
            for round in 0..40 {
                // Every other matrix holds few values, so that sums are equal.
                let draw = || match round % 2 {
                    0 => 7.0 * chance.uniform() - 2.0,
                    _ => chance.below(3) as f64 * 0.3,
                };
                let cost = Array2::from_shape_simple_fn((n, n), draw);
                let found = assign(cost.view());
                let least = orders.iter().map(|o| sum(&cost, o)).fold(f64::INFINITY, f64::min);
                // Six costs, each off by 2⁻⁴¹ of 5.
                assert!(sum(&cost, &found) <= least + 2e-11, "{n} {round}: {found:?}");
                let equal = orders.iter().filter(|o| sum(&cost, o) <= least + 1e-12);
                let fewest = equal.map(|o| n_changed(o)).min().expect("an order");
                assert!(n_changed(&found) <= fewest, "{n} {round}: {found:?} changes too many");
            }
        }
    }

    #[test]
    fn equal_costs_change_nobody() {
        for n in [0, 1, 5, 16] {
            let kept: Vec<usize> = (0..n).collect();
            assert_eq!(assign(Array2::from_elem((n, n), 3.7).view()), kept);
            assert_eq!(assign(Array2::zeros((n, n)).view()), kept);
        }
        // Dancers 1 and 3 cost the same wherever they go; 0 and 2 change.
        let mut cost = Array2::from_elem((4, 4), 1.0);
        (cost[[0, 2]], cost[[2, 0]]) = (0.0, 0.0);
        assert_eq!(assign(cost.view()), [2, 1, 0, 3]);
    }

    #[test]
    fn what_is_not_finite_is_left_to_the_last() {
        let (nan, inf) = (f64::NAN, f64::INFINITY);
        assert_eq!(assign(array![[nan, 1.0], [1.0, 5.0]].view()), [1, 0]);
        assert_eq!(
            assign(array![[1.0, inf, 2.0], [nan, 1.0, 1.0], [2.0, 1.0, nan]].view()),
            [0, 1, 2].map(|i| [0, 2, 1][i])
        );
        assert_eq!(assign(Array2::from_elem((3, 3), nan).view()), [0, 1, 2]);
    }
}
