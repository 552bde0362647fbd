//! The mathematics of vbar.
//!
//! Pure: values in, values out. No clock, file, socket, thread, environment, unseeded chance,
//! serialisation framework or async. If a computation needs to stop early, it asks a [`Budget`].
//!
//! Floors, from the ground up; a module uses lower floors only (`ARCHITECTURE.md`, checked by the
//! `tidy` test):
//!
//! | floor | modules |
//! | --- | --- |
//! | 5 | this front door |
//! | 4 | [`control`]: one folder a method |
//! | 3 | [`mission`], [`reach`] |
//! | 2 | [`dynamics`] |
//! | 1 | [`sets`], [`program`], [`orbit`], [`sampling`] |
//! | 0 | [`units`], [`frames`], [`epoch`], [`budget`], [`bytes`], `matrices` |
//!
//! References, cited by key throughout:
//!
//! - **\[AguilarMarsillach2022\]** Aguilar Marsillach, Di Cairano, Weiss, "Abort-Safe Spacecraft
//!   Rendezvous on Elliptic Orbits", IEEE TCST 2022, TR2022-142.
//! - **\[Quartullo2025a\]** Quartullo, Bianchini, Garulli, Giannitrapani, Leomanni, "Robust Variable
//!   Horizon Model Predictive Control for Rendezvous with Rotating Target", JGCD 2025,
//!   doi 10.2514/1.G008874.
//! - **\[Quartullo2025b\]** Quartullo, Bianchini, Garulli, Giannitrapani, "Robust Variable-Horizon
//!   MPC with Adaptive Terminal Constraints", Automatica 179, 2025, 112465.
//! - **\[Deaconu2014\]** Deaconu, Louembet, Théron, "Minimizing the Effects of Navigation
//!   Uncertainties on the Spacecraft Rendezvous Precision", JGCD 37(2), 2014, pp. 695-700,
//!   doi 10.2514/1.62219.
//! - **\[YamanakaAnkersen2002\]** Yamanaka, Ankersen, "New State Transition Matrix for Relative
//!   Motion on an Arbitrary Elliptical Orbit", JGCD 25(1), 2002, pp. 60-66.
//! - **\[Ros2002\]** Ros, Sabater, Thomas, "An Ellipsoidal Calculus Based on Propagation and
//!   Fusion", IEEE Transactions on Systems, Man, and Cybernetics B 32(4), 2002, pp. 430-442.
//! - **\[Mammarella2019\]** Mammarella, Lorenzen, Capello, Park, Dabbene, Guglieri, Romano,
//!   Allgoewer, "An Offline-Sampling SMPC Framework with Application to Autonomous Space Maneuvers",
//!   IEEE TCST 2019, doi 10.1109/TCST.2018.2879938.

pub mod budget;
pub mod bytes;
pub mod control;
pub mod dynamics;
pub mod epoch;
pub mod frames;
mod matrices;
pub mod mission;
pub mod orbit;
pub mod program;
pub mod reach;
pub mod sampling;
pub mod sets;
pub mod units;

pub use budget::{Budget, Interruption, Progress};
pub use control::{Failure, Method};
