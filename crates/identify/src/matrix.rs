//! Small symmetric matrices, with a fixed order of all sums: a result has the same bits on every machine.

use nalgebra::DMatrix;

/// Returns the dot product of two columns over a range of weighted rows.
fn weighted_dot(a: &[f64], b: &[f64], weights: &[f64]) -> f64 {
    a.iter().zip(b).zip(weights).map(|((a, b), w)| w * a * b).sum()
}

/// Returns JᵀWJ of columns and row weights.
pub fn gram(columns: &[Vec<f64>], weights: &[f64]) -> DMatrix<f64> {
    let n = columns.len();
    let mut out = DMatrix::zeros(n, n);
    for i in 0..n {
        for j in 0..=i {
            let dot = weighted_dot(&columns[i], &columns[j], weights);
            (out[(i, j)], out[(j, i)]) = (dot, dot);
        }
    }
    out
}

/// Returns JᵀWr.
pub fn gradient(columns: &[Vec<f64>], weights: &[f64], residuals: &[f64]) -> Vec<f64> {
    columns.iter().map(|column| weighted_dot(column, residuals, weights)).collect()
}

/// Solves A x = b for a symmetric positive definite A; `None` if it is not.
pub fn solve(a: &DMatrix<f64>, b: &[f64]) -> Option<Vec<f64>> {
    let n = b.len();
    let mut l = DMatrix::zeros(n, n);
    for i in 0..n {
        for j in 0..=i {
            let sum: f64 = (0..j).map(|k| l[(i, k)] * l[(j, k)]).sum();
            let rest = a[(i, j)] - sum;
            if i == j {
                if rest.is_nan() || rest <= 0.0 {
                    return None;
                }
                l[(i, i)] = rest.sqrt();
            } else {
                l[(i, j)] = rest / l[(j, j)];
            }
        }
    }
    let mut x = b.to_vec();
    for i in 0..n {
        let sum: f64 = (0..i).map(|k| l[(i, k)] * x[k]).sum();
        x[i] = (x[i] - sum) / l[(i, i)];
    }
    for i in (0..n).rev() {
        let sum: f64 = (i + 1..n).map(|k| l[(k, i)] * x[k]).sum();
        x[i] = (x[i] - sum) / l[(i, i)];
    }
    x.iter().all(|x| x.is_finite()).then_some(x)
}

/// Eigenvalues, largest first, each with its unit eigenvector. The largest component of a vector is positive.
///
/// Cyclic Jacobi rotations (Golub and Van Loan, Matrix Computations, 4th ed., algorithm 8.5.3).
pub fn eigen(a: &DMatrix<f64>) -> Vec<(f64, Vec<f64>)> {
    let n = a.nrows();
    let mut a = a.clone();
    let mut v = DMatrix::<f64>::identity(n, n);
    for _sweep in 0..60 {
        let off: f64 = (0..n).flat_map(|i| (0..i).map(move |j| (i, j))).map(|at| a[at] * a[at]).sum();
        let diagonal: f64 = (0..n).map(|i| a[(i, i)] * a[(i, i)]).sum();
        if off <= 1e-34 * diagonal {
            break;
        }
        for p in 0..n {
            for q in p + 1..n {
                rotate(&mut a, &mut v, p, q);
            }
        }
    }
    let vector = |j: usize| {
        let column: Vec<f64> = (0..n).map(|i| v[(i, j)]).collect();
        let largest = column.iter().copied().fold(0.0, |m: f64, x| if x.abs() > m.abs() { x } else { m });
        column.iter().map(|x| x * largest.signum()).collect()
    };
    let mut found: Vec<(f64, Vec<f64>)> = (0..n).map(|j| (a[(j, j)], vector(j))).collect();
    found.sort_by(|x, y| y.0.total_cmp(&x.0));
    found
}

fn rotate(a: &mut DMatrix<f64>, v: &mut DMatrix<f64>, p: usize, q: usize) {
    if a[(p, q)] == 0.0 {
        return;
    }
    let n = a.nrows();
    let tau = (a[(q, q)] - a[(p, p)]) / (2.0 * a[(p, q)]);
    let t = tau.signum() / (tau.abs() + (1.0 + tau * tau).sqrt());
    let c = 1.0 / (1.0 + t * t).sqrt();
    let s = t * c;
    for k in 0..n {
        let (x, y) = (a[(k, p)], a[(k, q)]);
        (a[(k, p)], a[(k, q)]) = (c * x - s * y, s * x + c * y);
    }
    for k in 0..n {
        let (x, y) = (a[(p, k)], a[(q, k)]);
        (a[(p, k)], a[(q, k)]) = (c * x - s * y, s * x + c * y);
    }
    for k in 0..n {
        let (x, y) = (v[(k, p)], v[(k, q)]);
        (v[(k, p)], v[(k, q)]) = (c * x - s * y, s * x + c * y);
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test fails by it")]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// Against nalgebra, whose eigenvalues have errors of some 1e-14 of the largest.
        #[test]
        fn eigenvalues_are_those_of_nalgebra(entries in prop::collection::vec(-3.0..3.0_f64, 25)) {
            let half = DMatrix::from_vec(5, 5, entries);
            let a = &half * half.transpose();
            let mut theirs: Vec<f64> = a.clone().symmetric_eigenvalues().iter().copied().collect();
            theirs.sort_by(|x, y| y.total_cmp(x));
            for ((value, vector), other) in eigen(&a).into_iter().zip(&theirs) {
                prop_assert!((value - other).abs() < 1e-12 * theirs[0].max(1.0));
                let v = nalgebra::DVector::from_vec(vector);
                prop_assert!((&a * &v - &v * value).norm() < 1e-12 * theirs[0].max(1.0));
            }
        }

        #[test]
        fn a_solution_satisfies_its_equation(entries in prop::collection::vec(-1.0..1.0_f64, 16)) {
            let half = DMatrix::from_vec(4, 4, entries);
            let a = &half * half.transpose() + DMatrix::identity(4, 4);
            let b = [1.0, -2.0, 3.0, 0.5];
            let x = nalgebra::DVector::from_vec(solve(&a, &b).unwrap());
            // Condition numbers are below 20 here.
            prop_assert!((a * x - nalgebra::DVector::from_row_slice(&b)).norm() < 1e-12);
        }
    }

    #[test]
    fn an_indefinite_matrix_has_no_solution() {
        assert_eq!(solve(&DMatrix::from_row_slice(2, 2, &[1.0, 2.0, 2.0, 1.0]), &[1.0, 1.0]), None);
    }
}
