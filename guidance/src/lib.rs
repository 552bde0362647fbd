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
//! | 1 | [`sets`], [`program`], [`sampling`] |
//! | 0 | [`units`], [`frames`], [`budget`], [`bytes`], `matrices` |
//!
//! References, cited by key throughout:
//!
//! - **\[Quartullo2025a\]** Quartullo, Bianchini, Garulli, Giannitrapani, Leomanni, "Robust Variable
//!   Horizon Model Predictive Control for Rendezvous with Rotating Target", JGCD 2025,
//!   doi 10.2514/1.G008874.
//! - **\[Quartullo2025b\]** Quartullo, Bianchini, Garulli, Giannitrapani, "Robust Variable-Horizon
//!   MPC with Adaptive Terminal Constraints", Automatica 179, 2025, 112465.
//! - **\[Mammarella2019\]** Mammarella, Lorenzen, Capello, Park, Dabbene, Guglieri, Romano,
//!   Allgoewer, "An Offline-Sampling SMPC Framework with Application to Automated Space Maneuvers",
//!   IEEE TCST 2019, doi 10.1109/TCST.2018.2879938.

pub mod budget;
pub mod bytes;
pub mod control;
pub mod dynamics;
pub mod frames;
mod matrices;
pub mod mission;
pub mod program;
pub mod reach;
pub mod sampling;
pub mod sets;
pub mod units;

pub use budget::{Budget, Interruption};
pub use control::{Failure, Method};
