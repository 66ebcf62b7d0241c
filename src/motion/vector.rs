//! Vectors of three numbers.

pub type Vector = [f64; 3];

/// Length of a vector.
pub fn norm(v: Vector) -> f64 {
    inner(v, v).sqrt()
}

/// Inner product.
pub fn inner(a: Vector, b: Vector) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Vector product.
pub fn cross(a: Vector, b: Vector) -> Vector {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// Difference `a - b`.
pub fn minus(a: Vector, b: Vector) -> Vector {
    std::array::from_fn(|i| a[i] - b[i])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn products_are_those_of_their_formulas() {
        let (a, b) = ([1.0, 2.0, 3.0], [-4.0, 5.0, 0.5]);
        assert_eq!(inner(a, b), 7.5);
        // (2·0.5 − 3·5, 3·(−4) − 1·0.5, 1·5 − 2·(−4)), at a right angle to both.
        assert_eq!(cross(a, b), [-14.0, -12.5, 13.0]);
        assert_eq!([inner(a, cross(a, b)), inner(b, cross(a, b))], [0.0, 0.0]);
        assert_eq!(minus(a, b), [5.0, -3.0, 2.5]);
        assert_eq!(norm([2.0, -3.0, 6.0]), 7.0);
    }
}
