//! Polytopes {x : H x <= b}.

use nalgebra::{DMatrix, DVector};

/// {x : normals x <= offsets}; normals q x n, offsets q. May be unbounded or empty.
#[derive(Debug, Clone, PartialEq)]
pub struct Polytope {
    normals: DMatrix<f64>,
    offsets: DVector<f64>,
}

impl Polytope {
    /// Normals q x n, offsets q.
    ///
    /// # Panics
    /// If the rows do not match.
    #[must_use]
    pub fn new(normals: DMatrix<f64>, offsets: DVector<f64>) -> Self {
        assert_eq!(normals.nrows(), offsets.len(), "rows of normals and offsets");
        Self { normals, offsets }
    }

    /// Normals H, q x n.
    #[must_use]
    pub fn normals(&self) -> &DMatrix<f64> {
        &self.normals
    }

    /// Offsets b, q.
    #[must_use]
    pub fn offsets(&self) -> &DVector<f64> {
        &self.offsets
    }

    /// b - H x: negative where a row is violated.
    #[must_use]
    pub fn margins(&self, point: &DVector<f64>) -> DVector<f64> {
        &self.offsets - &self.normals * point
    }
}
