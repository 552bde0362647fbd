//! Facets, vertices and volume of zonotopes in up to three dimensions.

use nalgebra::{DMatrix, DVector};

use super::{ConvexSet, Polytope, Zonotope};
use crate::matrices::times_vector;

/// Entries below this part of the largest are rounding: the cut between flat and not flat.
const FLAT: f64 = 1e-10;
/// Most distinct generators whose 2^p sign points are searched for vertices.
const VERTEX_GENERATORS_MAX: usize = 16;

/// A zonotope in R^3 as the facets of the part of space it fills.
///
/// A set of working thrusters may fill a segment or a plane only; its facets then live in the
/// coordinates w of that plane: x = origin + basis w.
#[derive(Debug, Clone, PartialEq)]
pub struct ZonotopeFacets {
    /// A point of the affine hull, n.
    pub origin: DVector<f64>,
    /// Orthonormal directions of the affine hull, n x d.
    pub basis: DMatrix<f64>,
    /// {w : normals w <= offsets}, unit normals in d dimensions; no rows if d = 0.
    pub facets: Polytope,
}

impl ZonotopeFacets {
    /// Dimension d of the affine hull.
    #[must_use]
    pub fn dimension(&self) -> usize {
        self.basis.ncols()
    }

    /// Is `point` at least `margin` inside every facet, and is the set full-dimensional?
    #[must_use]
    pub fn has_inside(&self, point: &DVector<f64>, margin: f64) -> bool {
        let w = times_vector(&self.basis.transpose(), &(point - &self.origin));
        self.dimension() == self.basis.nrows()
            && self.facets.margins(&w).iter().all(|&m| m >= margin)
    }
}

impl Zonotope {
    /// The affine hull and the facets in it.
    ///
    /// Normals of a zonotope's facets are orthogonal to d - 1 independent generators: enumerated.
    ///
    /// # Panics
    /// If the space has more than three dimensions.
    #[must_use]
    pub fn facets(&self) -> ZonotopeFacets {
        assert!(self.dimension() <= 3, "facets in {} dimensions", self.dimension());
        let basis = orthonormal_span(self.generators());
        let d = basis.ncols();
        let flat = crate::matrices::product(&basis.transpose(), &distinct(self.generators()));
        let mut normals: Vec<DVector<f64>> = Vec::new();
        let mut keep = |normal: DVector<f64>| {
            let length = normal.norm();
            if length <= FLAT {
                return;
            }
            let normal = normal / length;
            if !normals.iter().any(|other| (other.dot(&normal).abs() - 1.0).abs() < FLAT) {
                normals.push(normal);
            }
        };
        let g = |i: usize| {
            let column = flat.column(i).into_owned();
            let length = column.norm();
            column / length
        };
        match d {
            0 => {}
            1 => keep(DVector::from_element(1, 1.0)),
            2 => (0..flat.ncols()).for_each(|i| keep(DVector::from_vec(vec![-g(i)[1], g(i)[0]]))),
            _ => {
                for i in 0..flat.ncols() {
                    for j in 0..i {
                        keep(g(i).cross(&g(j)));
                    }
                }
            }
        }
        let centred = Zonotope::centred(flat);
        let rows = 2 * normals.len();
        let mut matrix = DMatrix::zeros(rows, d);
        let mut offsets = DVector::zeros(rows);
        for (i, normal) in normals.iter().enumerate() {
            for (row, sign) in [(2 * i, 1.0), (2 * i + 1, -1.0)] {
                matrix.row_mut(row).copy_from(&(normal * sign).transpose());
                offsets[row] = centred.support_function(normal);
            }
        }
        ZonotopeFacets {
            origin: self.centre().clone(),
            basis,
            facets: Polytope::new(matrix, offsets),
        }
    }

    /// The vertices, each once, in the order of their signs.
    ///
    /// # Panics
    /// If the space has more than three dimensions or the set more than 16 distinct generators.
    #[must_use]
    pub fn vertices(&self) -> Vec<DVector<f64>> {
        let shape = self.facets();
        let d = shape.dimension();
        let distinct = distinct(self.generators());
        assert!(distinct.ncols() <= VERTEX_GENERATORS_MAX, "{} generators", distinct.ncols());
        let size = 1.0 + self.half_widths().norm();
        let mut vertices: Vec<DVector<f64>> = Vec::new();
        for point in Zonotope::new(self.centre().clone(), distinct).sign_points() {
            let w = times_vector(&shape.basis.transpose(), &(&point - &shape.origin));
            let margins = shape.facets.margins(&w);
            let scale = shape.facets.offsets().amax().max(f64::MIN_POSITIVE);
            let tight: Vec<usize> =
                (0..margins.len()).filter(|&i| margins[i] <= 1e-9 * scale).collect();
            let normals = shape.facets.normals().select_rows(&tight);
            let corner = d == 0 || orthonormal_span(&normals.transpose()).ncols() == d;
            if corner && !vertices.iter().any(|v| (v - &point).norm() <= 1e-12 * size) {
                vertices.push(point);
            }
        }
        vertices
    }

    /// Volume in R^3: 8 sum |det [g_i g_j g_k]| over triples of generators; 0 if flat.
    ///
    /// # Panics
    /// If the space is not three-dimensional.
    #[must_use]
    pub fn volume(&self) -> f64 {
        assert_eq!(self.dimension(), 3, "volume in three dimensions");
        let g = self.generators();
        let mut sum = 0.0;
        for i in 0..g.ncols() {
            for j in 0..i {
                let cross = g.column(i).cross(&g.column(j));
                sum += (0..j).map(|k| cross.dot(&g.column(k)).abs()).sum::<f64>();
            }
        }
        8.0 * sum
    }
}

/// Generators with parallel ones added up and zeros left out: the same centred zonotope.
fn distinct(generators: &DMatrix<f64>) -> DMatrix<f64> {
    let largest = generators.column_iter().map(|g| g.norm()).fold(0.0, f64::max);
    let mut kept: Vec<DVector<f64>> = Vec::new();
    for g in generators.column_iter().filter(|g| g.norm() > FLAT * largest) {
        let parallel = kept.iter_mut().find(|k| {
            let cosine = k.dot(&g) / (k.norm() * g.norm());
            (cosine.abs() - 1.0).abs() < FLAT
        });
        match parallel {
            Some(k) => {
                let sign = if k.dot(&g) < 0.0 { -1.0 } else { 1.0 };
                *k += g * sign;
            }
            None => kept.push(g.into_owned()),
        }
    }
    if kept.is_empty() {
        DMatrix::zeros(generators.nrows(), 0)
    } else {
        DMatrix::from_columns(&kept)
    }
}

/// Orthonormal basis of the span of the columns, by Gram-Schmidt with the longest rest first.
fn orthonormal_span(columns: &DMatrix<f64>) -> DMatrix<f64> {
    let n = columns.nrows();
    let mut rest: Vec<DVector<f64>> = columns.column_iter().map(|c| c.into_owned()).collect();
    let largest = rest.iter().map(|c| c.norm()).fold(0.0, f64::max);
    let mut basis: Vec<DVector<f64>> = Vec::new();
    while basis.len() < n {
        let longest = (0..rest.len()).max_by(|&i, &j| rest[i].norm().total_cmp(&rest[j].norm()));
        let Some(pivot) = longest.map(|i| rest[i].clone()) else { break };
        if pivot.norm() <= FLAT * largest || largest == 0.0 {
            break;
        }
        let length = pivot.norm();
        let direction = pivot / length;
        for c in &mut rest {
            for _ in 0..2 {
                let part = c.dot(&direction);
                *c -= &direction * part;
            }
        }
        basis.push(direction);
    }
    if basis.is_empty() { DMatrix::zeros(n, 0) } else { DMatrix::from_columns(&basis) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cube_has_its_facets_vertices_and_volume() {
        let cube = Zonotope::centred(DMatrix::identity(3, 3));
        let shape = cube.facets();
        assert_eq!((shape.dimension(), shape.facets.offsets().len()), (3, 6));
        assert_eq!(cube.vertices().len(), 8);
        assert!((cube.volume() - 8.0).abs() < 1e-14);
        assert!(shape.has_inside(&DVector::zeros(3), 0.99));
        assert!(!shape.has_inside(&DVector::from_vec(vec![1.5, 0.0, 0.0]), 0.0));
    }

    #[test]
    fn coplanar_generators_make_a_hexagonal_prism() {
        // Three generators in a plane and one across it: a hexagon has 6 corners, the prism 12.
        #[rustfmt::skip]
        let generators = DMatrix::from_row_slice(3, 4, &[
            1.0, 0.0, 1.0, 0.0,
            0.0, 1.0, 1.0, 0.0,
            0.0, 0.0, 0.0, 2.0,
        ]);
        let prism = Zonotope::centred(generators);
        assert_eq!(prism.vertices().len(), 12);
        assert_eq!(prism.facets().facets.offsets().len(), 8);
        // Area of the hexagon 4 (1 + 1 + 1), height 4.
        assert!((prism.volume() - 48.0).abs() < 1e-12);
    }

    #[test]
    fn flat_sets_live_in_their_own_plane() {
        let plane = DMatrix::from_row_slice(3, 2, &[1.0, 1.0, 1.0, -1.0, 0.0, 0.0]);
        let flat = Zonotope::new(DVector::from_vec(vec![0.0, 0.0, 5.0]), plane);
        let shape = flat.facets();
        assert_eq!((shape.dimension(), flat.vertices().len(), flat.volume()), (2, 4, 0.0));
        assert!(!shape.has_inside(&DVector::from_vec(vec![0.0, 0.0, 5.0]), 0.0));
        let antiparallel = DMatrix::from_row_slice(3, 2, &[1.0, -1.0, 0.0, 0.0, 0.0, 0.0]);
        let segment = Zonotope::centred(antiparallel);
        assert_eq!((segment.facets().dimension(), segment.vertices().len()), (1, 2));
        let point = Zonotope::centred(DMatrix::zeros(3, 2));
        assert_eq!((point.facets().dimension(), point.vertices().len()), (0, 1));
    }
}
