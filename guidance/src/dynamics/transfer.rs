//! Predictions over a horizon as linear functions of the present state, the corrections and the
//! disturbances. [Mammarella2019, eq. 6 and appendix A]

use nalgebra::DMatrix;

use super::PlantMatrices;
use crate::matrices::product;

/// x_l = state_l x_0 + correction_l v + disturbance_l w for u_l = K x_l + v_l, l = 0 .. T.
#[derive(Debug, Clone, PartialEq)]
pub struct Transfer {
    /// n x n, one a stage.
    pub state: Vec<DMatrix<f64>>,
    /// n x T m, one a stage.
    pub correction: Vec<DMatrix<f64>>,
    /// n x T p, one a stage.
    pub disturbance: Vec<DMatrix<f64>>,
}

impl Transfer {
    /// For the matrices of T steps and a gain K (m x n).
    #[must_use]
    pub fn new(steps: &[PlantMatrices], gain: &DMatrix<f64>) -> Self {
        let (m, n) = gain.shape();
        let p = steps.first().map_or(0, |step| step.b_w.ncols());
        let horizon = steps.len();
        let mut transfer = Self {
            state: vec![DMatrix::identity(n, n)],
            correction: vec![DMatrix::zeros(n, horizon * m)],
            disturbance: vec![DMatrix::zeros(n, horizon * p)],
        };
        for (l, step) in steps.iter().enumerate() {
            let closed = &step.a + product(&step.b, gain);
            transfer.state.push(product(&closed, &transfer.state[l]));
            let mut correction = product(&closed, &transfer.correction[l]);
            correction.view_mut((0, l * m), (n, m)).copy_from(&step.b);
            transfer.correction.push(correction);
            let mut disturbance = product(&closed, &transfer.disturbance[l]);
            disturbance.view_mut((0, l * p), (n, p)).copy_from(&step.b_w);
            transfer.disturbance.push(disturbance);
        }
        transfer
    }
}

/// The prediction of one sample, with its disturbance folded in: x_l and u_l as matrices over
/// (x_0, v_0 .. v_{T-1}, 1).
///
/// The constant 1 is where this leaves the paper: the printed block sizes of (7) and appendix A
/// do not fit, and only the sum over w is ever used.
#[derive(Debug, Clone, PartialEq)]
pub struct Prediction {
    /// x_0 .. x_T: n x (n + T m + 1) each.
    pub states: Vec<DMatrix<f64>>,
    /// u_0 .. u_{T-1}: m x (n + T m + 1) each.
    pub inputs: Vec<DMatrix<f64>>,
}

impl Prediction {
    /// For the matrices and disturbances of `steps`, of a horizon that may be longer: only as
    /// many stages as there are steps are predicted, over all T m corrections.
    #[must_use]
    pub fn new(
        steps: &[PlantMatrices],
        disturbances: &[Vec<f64>],
        gain: &DMatrix<f64>,
        horizon: usize,
    ) -> Self {
        let (m, n) = gain.shape();
        let width = n + horizon * m + 1;
        let mut state = DMatrix::zeros(n, width);
        state.view_mut((0, 0), (n, n)).fill_with_identity();
        let mut prediction = Self { states: vec![state], inputs: Vec::with_capacity(steps.len()) };
        for (l, (step, w)) in steps.iter().zip(disturbances).enumerate() {
            let state = &prediction.states[l];
            // Column by column; those of later corrections are still zero.
            let known = n + l * m;
            let mut next = DMatrix::zeros(n, width);
            let mut input = DMatrix::zeros(m, width);
            for c in (0..known).chain([width - 1]) {
                for i in 0..m {
                    input[(i, c)] = (0..n).map(|k| gain[(i, k)] * state[(k, c)]).sum();
                }
            }
            (0..m).for_each(|i| input[(i, known + i)] = 1.0);
            for c in (0..known + m).chain([width - 1]) {
                for i in 0..n {
                    let free: f64 = (0..n).map(|k| step.a[(i, k)] * state[(k, c)]).sum();
                    let forced: f64 = (0..m).map(|k| step.b[(i, k)] * input[(k, c)]).sum();
                    next[(i, c)] = free + forced;
                }
            }
            for i in 0..n {
                let pushed: f64 = w.iter().enumerate().map(|(k, w)| step.b_w[(i, k)] * w).sum();
                next[(i, width - 1)] += pushed;
            }
            prediction.inputs.push(input);
            prediction.states.push(next);
        }
        prediction
    }
}
