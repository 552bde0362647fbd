//! Linear plants whose matrices depend on uncertain parameters, x+ = A(q) x + B(q) u + B_w(q) w.

use nalgebra::DMatrix;

use super::zero_order_hold;
use crate::sampling::{ScalarLaw, Stream};

/// A plant with uncertain parameters q, each with a law of its own. [Mammarella2019, eq. 1]
#[derive(Debug, Clone, PartialEq)]
pub struct UncertainPlant {
    /// A(q), n x n.
    pub a: MatrixPolynomial,
    /// B(q), n x m.
    pub b: MatrixPolynomial,
    /// B_w(q), n x p. In discrete time even if A and B are continuous: w is what is added to the
    /// next state.
    pub b_w: MatrixPolynomial,
    /// Law of each parameter; they are independent, and drawn anew at every step.
    pub parameters: Vec<ScalarLaw>,
    /// How A and B become those of a step.
    pub discretisation: Discretisation,
}

/// A matrix whose entries are polynomials of the parameters: a sum of terms.
#[derive(Debug, Clone, PartialEq)]
pub struct MatrixPolynomial {
    /// The value at q = 0.
    pub constant: DMatrix<f64>,
    /// What is added to it.
    pub terms: Vec<Monomial>,
}

/// matrix * product of q_i^powers_i.
#[derive(Debug, Clone, PartialEq)]
pub struct Monomial {
    /// One power a parameter; missing ones are 0.
    pub powers: Vec<u32>,
    /// The factor.
    pub matrix: DMatrix<f64>,
}

/// How the matrices of a step follow from A(q) and B(q).
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Discretisation {
    /// They are those of a step.
    None,
    /// Exactly, with q and u held for `sample_time_s`.
    ZeroOrderHold {
        /// Seconds between samples.
        sample_time_s: f64,
    },
    /// I + A t and B t.
    Euler {
        /// Seconds between samples.
        sample_time_s: f64,
    },
}

/// The matrices of one step.
#[derive(Debug, Clone, PartialEq)]
pub struct PlantMatrices {
    /// A, n x n.
    pub a: DMatrix<f64>,
    /// B, n x m.
    pub b: DMatrix<f64>,
    /// B_w, n x p.
    pub b_w: DMatrix<f64>,
}

/// What does not make a plant.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum UncertainPlantError {
    /// Matrices that do not fit each other.
    #[error("{0}")]
    Shape(String),
    /// A law of a parameter without sense.
    #[error("parameter {0} has no sound law")]
    Law(usize),
    /// A sample time that is not positive.
    #[error("the sample time is not positive and finite")]
    SampleTime,
}

/// Most parameters for which the corners of their box are enumerated: 4096 plants.
const CORNER_PARAMETERS_MAX: usize = 12;

impl MatrixPolynomial {
    /// The same for every q.
    #[must_use]
    pub fn constant(matrix: DMatrix<f64>) -> Self {
        Self { constant: matrix, terms: Vec::new() }
    }

    /// Adds q_i * `matrix`.
    #[must_use]
    pub fn with_linear(mut self, i: usize, matrix: DMatrix<f64>) -> Self {
        let mut powers = vec![0; i + 1];
        powers[i] = 1;
        self.terms.push(Monomial { powers, matrix });
        self
    }

    /// The matrix at q.
    #[must_use]
    pub fn at(&self, q: &[f64]) -> DMatrix<f64> {
        let mut sum = self.constant.clone();
        for term in &self.terms {
            let mut factor = 1.0;
            for (&power, &value) in term.powers.iter().zip(q) {
                (0..power).for_each(|_| factor *= value);
            }
            sum += &term.matrix * factor;
        }
        sum
    }

    fn fits(&self, rows: usize, columns: usize, parameters: usize) -> bool {
        let sound =
            |m: &DMatrix<f64>| m.shape() == (rows, columns) && m.iter().all(|x| x.is_finite());
        sound(&self.constant)
            && self.terms.iter().all(|t| sound(&t.matrix) && t.powers.len() <= parameters)
    }
}

impl UncertainPlant {
    /// n.
    #[must_use]
    pub fn states(&self) -> usize {
        self.a.constant.nrows()
    }

    /// m.
    #[must_use]
    pub fn inputs(&self) -> usize {
        self.b.constant.ncols()
    }

    /// p.
    #[must_use]
    pub fn disturbances(&self) -> usize {
        self.b_w.constant.ncols()
    }

    /// Do the parts fit each other?
    ///
    /// # Errors
    /// [`UncertainPlantError`], the first fault found.
    pub fn check(&self) -> Result<(), UncertainPlantError> {
        let (n, m, p, q) =
            (self.states(), self.inputs(), self.disturbances(), self.parameters.len());
        for (name, matrix, columns) in [("A", &self.a, n), ("B", &self.b, m), ("B_w", &self.b_w, p)]
        {
            if n == 0 || columns == 0 || !matrix.fits(n, columns, q) {
                let text = format!("{name} and its terms must be finite and {n} x {columns}");
                return Err(UncertainPlantError::Shape(text));
            }
        }
        if let Some(i) = self.parameters.iter().position(|law| law.check().is_err()) {
            return Err(UncertainPlantError::Law(i));
        }
        match self.discretisation {
            Discretisation::ZeroOrderHold { sample_time_s: t }
            | Discretisation::Euler { sample_time_s: t }
                if !(t > 0.0 && t.is_finite()) =>
            {
                Err(UncertainPlantError::SampleTime)
            }
            _ => Ok(()),
        }
    }

    /// The matrices of one step at q.
    #[must_use]
    pub fn at(&self, q: &[f64]) -> PlantMatrices {
        let (a, b) = (self.a.at(q), self.b.at(q));
        let (a, b) = match self.discretisation {
            Discretisation::None => (a, b),
            Discretisation::ZeroOrderHold { sample_time_s } => {
                zero_order_hold(&a, &b, sample_time_s)
            }
            Discretisation::Euler { sample_time_s } => {
                let n = a.nrows();
                (DMatrix::identity(n, n) + a * sample_time_s, b * sample_time_s)
            }
        };
        PlantMatrices { a, b, b_w: self.b_w.at(q) }
    }

    /// The matrices at the expected parameters.
    #[must_use]
    pub fn at_mean(&self) -> PlantMatrices {
        let q: Vec<f64> = self.parameters.iter().map(ScalarLaw::mean).collect();
        self.at(&q)
    }

    /// The matrices at parameters drawn from `stream`.
    #[must_use]
    pub fn draw(&self, stream: &mut Stream) -> PlantMatrices {
        let q: Vec<f64> = self.parameters.iter().map(|law| law.draw(stream)).collect();
        self.at(&q)
    }

    /// The matrices at the corners of the parameters' box; `None` beyond twelve parameters that
    /// vary.
    ///
    /// Their convex hull holds every plant if the step's matrices are affine in each parameter,
    /// as they are without discretisation or by Euler's for affine A and B. The exact
    /// discretisation bends them by terms of second order in q; then an outer set must be given
    /// by who states the problem, or the guarantee is for the hull only.
    #[must_use]
    pub fn corners(&self) -> Option<Vec<PlantMatrices>> {
        let ranges: Vec<(f64, f64)> = self.parameters.iter().map(ScalarLaw::range).collect();
        let varying: Vec<usize> =
            (0..ranges.len()).filter(|&i| ranges[i].0 < ranges[i].1).collect();
        if varying.len() > CORNER_PARAMETERS_MAX {
            return None;
        }
        let corner = |signs: usize| {
            let mut q: Vec<f64> = ranges.iter().map(|range| range.0).collect();
            for (place, &i) in varying.iter().enumerate() {
                if signs >> (varying.len() - 1 - place) & 1 == 1 {
                    q[i] = ranges[i].1;
                }
            }
            self.at(&q)
        };
        Some((0..1_usize << varying.len()).map(corner).collect())
    }
}
