//! Chance constraints as linear rows, one for every sample.

use nalgebra::DMatrix;

use super::HalfSpaces;
use crate::dynamics::Prediction;

/// What must hold along a horizon of T steps.
#[derive(Debug, Clone, PartialEq)]
pub struct StageConstraints {
    /// H_x x_l <= h_x, at stages 1 .. T-1, and at stage 0 if asked.
    pub state: HalfSpaces,
    /// H_u u_l <= h_u, at stages 0 .. T-1.
    pub input: HalfSpaces,
    /// H_T x_T <= h_T.
    pub terminal: HalfSpaces,
}

/// Which constraint is meant.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum StageFamily {
    /// H_x x <= h_x.
    State,
    /// H_u u <= h_u.
    Input,
    /// H_T x_T <= h_T.
    Terminal,
}

/// The rows of one family at one stage: they are sampled together.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct StageGroup {
    /// Which family.
    pub family: StageFamily,
    /// l, 0 .. T.
    pub stage: usize,
}

impl StageGroup {
    /// Every group of a horizon, in a fixed order.
    ///
    /// At stage 0 the state is measured and no decision: its rows would turn the chance
    /// constraint of the last step into a robust one, so they are left out unless asked for. The
    /// input of stage 0 is decided and bounded.
    #[must_use]
    pub fn all(horizon: usize, state_at_start: bool) -> Vec<Self> {
        let states = usize::from(!state_at_start)..horizon;
        let group = |family| move |stage| Self { family, stage };
        states
            .map(group(StageFamily::State))
            .chain((0..horizon).map(group(StageFamily::Input)))
            .chain([Self { family: StageFamily::Terminal, stage: horizon }])
            .collect()
    }

    /// Steps that a prediction must cover for this group.
    #[must_use]
    pub fn steps(&self) -> usize {
        match self.family {
            StageFamily::Input => self.stage + 1,
            StageFamily::State | StageFamily::Terminal => self.stage,
        }
    }
}

impl StageConstraints {
    /// Rows of a family.
    #[must_use]
    pub fn of(&self, family: StageFamily) -> &HalfSpaces {
        match family {
            StageFamily::State => &self.state,
            StageFamily::Input => &self.input,
            StageFamily::Terminal => &self.terminal,
        }
    }

    /// Appends these faces of `group` for one sample to `rows`, which are over (x_0, v_0 ..
    /// v_{T-1}): H M z <= h - H c with x_l = M z + c. [Mammarella2019, eqs. 9-12]
    ///
    /// # Panics
    /// If the prediction is shorter than [`StageGroup::steps`], or a face is none of the group's.
    pub fn push_rows(
        &self,
        group: StageGroup,
        faces: &[usize],
        prediction: &Prediction,
        rows: &mut HalfSpaces,
    ) {
        let predicted: &DMatrix<f64> = match group.family {
            StageFamily::Input => &prediction.inputs[group.stage],
            StageFamily::State | StageFamily::Terminal => &prediction.states[group.stage],
        };
        let constraints = self.of(group.family);
        let width = predicted.ncols() - 1;
        let mut normal = vec![0.0; width];
        for &row in faces {
            let h = constraints.normal(row);
            let along = |column: usize| -> f64 {
                h.iter().enumerate().map(|(k, h)| h * predicted[(k, column)]).sum()
            };
            normal.iter_mut().enumerate().for_each(|(c, entry)| *entry = along(c));
            rows.push(&normal, constraints.offset(row) - along(width));
        }
    }
}
