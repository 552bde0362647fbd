//! Zonotopes {c + G xi : |xi|_inf <= 1}.

use nalgebra::{DMatrix, DVector};

use super::{ConvexSet, Polytope};
use crate::matrices;

/// {centre + generators xi : |xi|_inf <= 1}; generators n x p, one a column; p = 0 is a point.
#[derive(Debug, Clone, PartialEq)]
pub struct Zonotope {
    centre: DVector<f64>,
    generators: DMatrix<f64>,
}

/// How far a point is from the centre of a zonotope, measured by the zonotope itself.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ZonotopeGauge {
    /// Least t with the point's projection on the span of the generators in t Z; `None` without
    /// generators.
    pub gauge: Option<f64>,
    /// Euclidean norm of the part outside the span.
    pub residual_norm: f64,
}

/// A zonotope with the pseudo-inverse of its generators.
#[derive(Debug, Clone, PartialEq)]
pub struct ZonotopeMeasure {
    zonotope: Zonotope,
    pseudo_inverse: DMatrix<f64>,
    rank: usize,
    size: f64,
}

impl ZonotopeMeasure {
    /// Measures `point - centre`.
    ///
    /// Exact if the generators are linearly independent. Otherwise the least-norm coefficients
    /// are taken, which is an upper bound on the gauge: it can call a point outside that is
    /// inside, never the reverse.
    #[must_use]
    pub fn gauge(&self, point: &DVector<f64>) -> ZonotopeGauge {
        let difference = point - &self.zonotope.centre;
        if self.rank == 0 {
            return ZonotopeGauge { gauge: None, residual_norm: difference.norm() };
        }
        let coefficients = matrices::times_vector(&self.pseudo_inverse, &difference);
        let inside = matrices::times_vector(&self.zonotope.generators, &coefficients);
        ZonotopeGauge {
            gauge: Some(coefficients.amax()),
            residual_norm: (difference - inside).norm(),
        }
    }

    /// The part of `point - centre` in the span of the generators.
    #[must_use]
    pub fn inside_span(&self, point: &DVector<f64>) -> DVector<f64> {
        let difference = point - &self.zonotope.centre;
        let coefficients = matrices::times_vector(&self.pseudo_inverse, &difference);
        matrices::times_vector(&self.zonotope.generators, &coefficients)
    }

    /// Dimensions of the span of the generators.
    #[must_use]
    pub fn rank(&self) -> usize {
        self.rank
    }

    /// Norm of the half widths of the box around the set.
    #[must_use]
    pub fn size(&self) -> f64 {
        self.size
    }
}

impl Zonotope {
    /// Centre n, generators n x p.
    ///
    /// # Panics
    /// If the rows do not match.
    #[must_use]
    pub fn new(centre: DVector<f64>, generators: DMatrix<f64>) -> Self {
        assert_eq!(centre.len(), generators.nrows(), "rows of centre and generators");
        Self { centre, generators }
    }

    /// Centred at 0.
    #[must_use]
    pub fn centred(generators: DMatrix<f64>) -> Self {
        Self { centre: DVector::zeros(generators.nrows()), generators }
    }

    /// Centre c.
    #[must_use]
    pub fn centre(&self) -> &DVector<f64> {
        &self.centre
    }

    /// Generators G, n x p.
    #[must_use]
    pub fn generators(&self) -> &DMatrix<f64> {
        &self.generators
    }

    /// The single point at the centre?
    #[must_use]
    pub fn is_point(&self) -> bool {
        self.generators.iter().all(|&g| g == 0.0)
    }

    /// {M x : x in the set}, exact.
    #[must_use]
    pub fn linear_map(&self, map: &DMatrix<f64>) -> Self {
        Self {
            centre: matrices::times_vector(map, &self.centre),
            generators: matrices::product(map, &self.generators),
        }
    }

    /// {x + y}, exact: generators side by side.
    ///
    /// # Panics
    /// If the dimensions differ.
    #[must_use]
    pub fn minkowski_sum(&self, other: &Self) -> Self {
        assert_eq!(self.dimension(), other.dimension(), "dimensions of the summands");
        let mut generators = self
            .generators
            .clone()
            .resize_horizontally(self.generators.ncols() + other.generators.ncols(), 0.0);
        generators
            .columns_mut(self.generators.ncols(), other.generators.ncols())
            .copy_from(&other.generators);
        Self { centre: &self.centre + &other.centre, generators }
    }

    /// Half widths of the smallest box around the set, about its centre.
    #[must_use]
    pub fn half_widths(&self) -> DVector<f64> {
        DVector::from_iterator(
            self.dimension(),
            self.generators.row_iter().map(|row| row.iter().map(|g| g.abs()).sum()),
        )
    }

    /// Prepares for measuring many points by this set.
    #[must_use]
    pub fn measure(&self) -> ZonotopeMeasure {
        let (pseudo_inverse, rank) = matrices::pseudo_inverse(&self.generators);
        let size = self.half_widths().norm();
        ZonotopeMeasure { zonotope: self.clone(), pseudo_inverse, rank, size }
    }

    /// The 2^p sign combinations, as vertices (some may be interior).
    ///
    /// # Panics
    /// If p > 20.
    #[must_use]
    pub fn sign_points(&self) -> Vec<DVector<f64>> {
        let p = self.generators.ncols();
        assert!(p <= 20, "2^p points of {p} generators");
        (0..1usize << p)
            .map(|signs| {
                let mut point = self.centre.clone();
                for j in 0..p {
                    let sign = if signs >> j & 1 == 1 { 1.0 } else { -1.0 };
                    point += self.generators.column(j) * sign;
                }
                point
            })
            .collect()
    }

    /// {x : x + Z inside P} for a polytope P: each offset shrinks by the support of the set.
    /// Exact for any Z; the result can be empty.
    #[must_use]
    pub fn pontryagin_shrink(&self, polytope: &Polytope) -> Polytope {
        let offsets = DVector::from_iterator(
            polytope.offsets().len(),
            polytope
                .normals()
                .row_iter()
                .zip(polytope.offsets().iter())
                .map(|(normal, offset)| offset - self.support_function(&normal.transpose())),
        );
        Polytope::new(polytope.normals().clone(), offsets)
    }
}

impl ConvexSet for Zonotope {
    fn dimension(&self) -> usize {
        self.centre.len()
    }

    fn support_function(&self, direction: &DVector<f64>) -> f64 {
        let spread: f64 = self.generators.column_iter().map(|g| direction.dot(&g).abs()).sum();
        direction.dot(&self.centre) + spread
    }
}
