//! Where a mission starts, for callers who do not fly it here.

use vbar_proto::v1::{Frame, LinearState, Measurement, RelativeState, measurement};

use super::{Mission, Scheme, law::InitialLaw, variable_horizon_mut};

impl Mission {
    /// The measurement of step 0 if the mission starts at one fixed state; where it starts by
    /// chance there is none.
    #[must_use]
    pub fn fixed_start(&self) -> Option<Measurement> {
        let (state, elapsed_s) = match &self.simulation.initial_state {
            InitialLaw::Fixed { position_m, velocity_m_s } => {
                let state = RelativeState {
                    frame: Frame::Rtn.into(),
                    position_m: position_m.to_vec(),
                    velocity_m_s: velocity_m_s.to_vec(),
                };
                (measurement::State::Relative(state), Some(0.0))
            }
            InitialLaw::FixedComponents(components) => {
                let state = LinearState { components: components.clone() };
                (measurement::State::Linear(state), None)
            }
            InitialLaw::InCone { .. } | InitialLaw::Box { .. } => return None,
        };
        Some(Measurement { state: Some(state), elapsed_s, ..Measurement::default() })
    }

    /// The same mission under another controller.
    #[must_use]
    pub fn with_scheme(mut self, scheme: Scheme) -> Self {
        if let Some(inner) = variable_horizon_mut(&mut self.problem) {
            inner.set_scheme(scheme);
        }
        self
    }
}
