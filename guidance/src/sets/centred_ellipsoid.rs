//! Ellipsoids around the origin, {x : x' P x <= 1}.

use nalgebra::{DMatrix, DVector};

use super::ConvexSet;
use crate::matrices::times_vector;

/// {x : x' P x <= 1} with P (n x n) symmetric positive definite; P is the inverse of the shape
/// matrix Q of the papers.
#[derive(Debug, Clone, PartialEq)]
pub struct CentredEllipsoid {
    precision: DMatrix<f64>,
}

/// A half-space {x : normal x <= 1} that holds a set, touching it.
#[derive(Debug, Clone, PartialEq)]
pub struct Tangent {
    /// h, n.
    pub normal: DVector<f64>,
    /// h x - 1 at the point the tangent was made for: positive if the point is outside.
    pub clearance: f64,
}

impl CentredEllipsoid {
    /// From P; `None` unless it is symmetric positive definite.
    #[must_use]
    pub fn from_precision(precision: DMatrix<f64>) -> Option<Self> {
        let size = precision.amax();
        let square = precision.is_square();
        if !square || !((&precision - precision.transpose()).amax() <= 1e-9 * size) {
            return None;
        }
        let symmetric = (&precision + precision.transpose()) * 0.5;
        nalgebra::Cholesky::new(symmetric.clone()).map(|_| Self { precision: symmetric })
    }

    /// With semi-axes along the coordinate axes, each positive.
    #[must_use]
    pub fn from_semi_axes(semi_axes: &[f64]) -> Self {
        let squares = semi_axes.iter().map(|a| 1.0 / (a * a));
        let diagonal = DVector::from_iterator(semi_axes.len(), squares);
        Self { precision: DMatrix::from_diagonal(&diagonal) }
    }

    /// P, n x n.
    #[must_use]
    pub fn precision(&self) -> &DMatrix<f64> {
        &self.precision
    }

    /// x' P x: at most 1 inside; the square of the gauge.
    #[must_use]
    pub fn gauge_squared(&self, point: &DVector<f64>) -> f64 {
        point.dot(&times_vector(&self.precision, point))
    }

    /// The tangent plane at the radial projection y of `point`: h = P y, h y = 1, and
    /// h x - 1 = sqrt(x' P x) - 1. `None` at the centre.
    ///
    /// This is the optimum of the separation program (32) for one set. Remark 5's factor 2 is
    /// wrong: 2 P y x <= 1 cuts the ellipsoid in two. [AguilarMarsillach2022, eq. 32, remark 5]
    #[must_use]
    pub fn tangent(&self, point: &DVector<f64>) -> Option<Tangent> {
        let gauge = self.gauge_squared(point).sqrt();
        (gauge > 0.0).then(|| Tangent {
            normal: times_vector(&self.precision, point) / gauge,
            clearance: gauge - 1.0,
        })
    }

    /// The point of the set nearest to `point` in the Euclidean norm.
    ///
    /// In principal axes y_i = x_i / (1 + t w_i); t >= 0 is the root of the decreasing function
    /// sum w_i y_i^2 - 1, found by bisection on its logarithm's bracket, then by Newton.
    #[must_use]
    pub fn nearest_point(&self, point: &DVector<f64>) -> DVector<f64> {
        if self.gauge_squared(point) <= 1.0 {
            return point.clone();
        }
        let eigen = nalgebra::SymmetricEigen::new(self.precision.clone());
        let weights = &eigen.eigenvalues;
        let x = times_vector(&eigen.eigenvectors.transpose(), point);
        let excess = |t: f64| -> f64 {
            let terms = weights.iter().zip(x.iter());
            terms.map(|(w, x)| w * (x / (1.0 + t * w)) * (x / (1.0 + t * w))).sum::<f64>() - 1.0
        };
        // At this t the sum is below sum w x^2 / (t w)^2 = 1.
        let mut high = weights.iter().zip(x.iter()).map(|(w, x)| x * x / w).sum::<f64>().sqrt();
        let mut low = 0.0;
        // Convex and decreasing: Newton from the left never passes the root.
        for _ in 0..500 {
            let value = excess(low);
            let slope: f64 = weights
                .iter()
                .zip(x.iter())
                .map(|(w, x)| -2.0 * w * w * x * x / libm::pow(1.0 + low * w, 3.0))
                .sum();
            let newton = low - value / slope;
            let middle = 0.5 * (low + high);
            if excess(middle) > 0.0 {
                low = middle.max(newton);
            } else {
                high = middle;
                low = low.max(newton.min(high));
            }
            if high - low <= 1e-16 * high || value <= 1e-15 {
                break;
            }
        }
        let nearest = DVector::from_fn(x.len(), |i, _| x[i] / (1.0 + low * weights[i]));
        times_vector(&eigen.eigenvectors, &nearest)
    }
}

impl ConvexSet for CentredEllipsoid {
    fn dimension(&self) -> usize {
        self.precision.nrows()
    }

    /// sqrt(d' P^-1 d).
    fn support_function(&self, direction: &DVector<f64>) -> f64 {
        let Some(factor) = nalgebra::Cholesky::new(self.precision.clone()) else {
            return f64::INFINITY;
        };
        direction.dot(&factor.solve(direction)).max(0.0).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tilted() -> CentredEllipsoid {
        let tilt = DMatrix::from_row_slice(3, 3, &[1.0, 0.4, 0.0, 0.0, 2.0, 0.3, 0.0, 0.0, 50.0]);
        CentredEllipsoid::from_precision(tilt.transpose() * tilt).unwrap()
    }

    #[test]
    fn tangent_touches_the_set_and_clears_the_point() {
        let set = tilted();
        let point = DVector::from_vec(vec![3.0, -1.0, 0.7]);
        let tangent = set.tangent(&point).unwrap();
        assert!((set.support_function(&tangent.normal) - 1.0).abs() < 1e-12);
        assert!((tangent.normal.dot(&point) - 1.0 - tangent.clearance).abs() < 1e-12);
        assert!(tangent.clearance > 0.0);
        assert_eq!(set.tangent(&DVector::zeros(3)), None);
    }

    #[test]
    fn nearest_point_is_on_the_set_and_the_way_is_normal_to_it() {
        let set = tilted();
        for point in [[3.0, -1.0, 0.7], [1e3, 0.0, 0.0], [0.0, 0.0, 0.03], [0.0, 0.5001, 0.0]] {
            let point = DVector::from_column_slice(&point);
            let nearest = set.nearest_point(&point);
            assert!((set.gauge_squared(&nearest) - 1.0).abs() < 1e-12, "{point}");
            let way = (&point - &nearest).normalize();
            let normal = times_vector(set.precision(), &nearest).normalize();
            assert!(way.dot(&normal) > 1.0 - 1e-9, "{point}");
        }
        let inside = DVector::from_vec(vec![0.1, 0.1, 0.0]);
        assert_eq!(set.nearest_point(&inside), inside);
    }

    #[test]
    fn indefinite_precision_is_refused() {
        let saddle = DMatrix::from_row_slice(2, 2, &[1.0, 0.0, 0.0, -1.0]);
        assert_eq!(CentredEllipsoid::from_precision(saddle), None);
        let skew = DMatrix::from_row_slice(2, 2, &[1.0, 0.5, -0.5, 1.0]);
        assert_eq!(CentredEllipsoid::from_precision(skew), None);
    }
}
