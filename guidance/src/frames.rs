//! Frames as types: a product of wrong frames does not compile.
//!
//! The core computes in [`Rtn`]. [`LvlhCcsds`] exists so that callers who use it are converted
//! once, at the door.

use std::marker::PhantomData;

use nalgebra::{Matrix3, Vector3};

mod sealed {
    pub trait Sealed {}
}

/// A set of axes. Sealed: the frames of this project are listed here and nowhere else.
pub trait Frame: sealed::Sealed + Copy + std::fmt::Debug {}

/// x radial (outward), y along-track, z orbit normal; also called RSW, QSW, Hill. Rotating.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Rtn;

/// x along-track, y minus orbit normal, z nadir, as in CCSDS `LVLH_ROTATING` and in the
/// Yamanaka-Ankersen papers. Rotating.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LvlhCcsds;

/// Axes that do not rotate, centred on the Earth; [`InertialAxes`] names which.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Inertial;

impl sealed::Sealed for Rtn {}
impl sealed::Sealed for LvlhCcsds {}
impl sealed::Sealed for Inertial {}
impl Frame for Rtn {}
impl Frame for LvlhCcsds {}
impl Frame for Inertial {}

/// Which inertial axes are meant: a label, carried and compared but not converted here.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InertialAxes {
    /// Mean equator and equinox of J2000.
    Eme2000,
    /// True equator, mean equinox of date: the axes of two-line elements.
    Teme,
    /// Geocentric celestial reference frame.
    Gcrf,
}

/// A rotation matrix that takes components in `From` to components in `To`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rotation<To: Frame, From: Frame> {
    matrix: Matrix3<f64>,
    frames: PhantomData<(To, From)>,
}

/// Takes LVLH_CCSDS components to RTN components: radial = -nadir, along-track = x,
/// normal = -y. The two frames rotate together, so velocities turn by the same matrix.
pub const RTN_FROM_LVLH_CCSDS: Rotation<Rtn, LvlhCcsds> = Rotation {
    matrix: Matrix3::new(0.0, 0.0, -1.0, 1.0, 0.0, 0.0, 0.0, -1.0, 0.0),
    frames: PhantomData,
};

impl<To: Frame, From: Frame> Rotation<To, From> {
    /// From its matrix, which must be orthonormal with determinant 1.
    pub(crate) fn from_matrix(matrix: Matrix3<f64>) -> Self {
        Self { matrix, frames: PhantomData }
    }

    /// The rotation the other way.
    #[must_use]
    pub fn inverse(&self) -> Rotation<From, To> {
        Rotation { matrix: self.matrix.transpose(), frames: PhantomData }
    }
}

/// A free vector (position difference, velocity, acceleration, angular velocity) with its frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InFrame<F: Frame> {
    /// Components along the axes of `F`, in the unit that the holder's name says.
    pub components: Vector3<f64>,
    frame: PhantomData<F>,
}

impl<F: Frame> InFrame<F> {
    /// A vector from its components.
    #[must_use]
    pub fn new(components: Vector3<f64>) -> Self {
        Self { components, frame: PhantomData }
    }
}

impl<To: Frame, From: Frame> std::ops::Mul<InFrame<From>> for Rotation<To, From> {
    type Output = InFrame<To>;

    fn mul(self, vector: InFrame<From>) -> InFrame<To> {
        InFrame::new(self.matrix * vector.components)
    }
}

/// State of the chaser relative to the target, as seen in the rotating frame `F`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RelativeState<F: Frame = Rtn> {
    /// Position of the chaser's centre of mass from the target's, metres.
    pub position_m: InFrame<F>,
    /// Its rate of change in the rotating frame, metres per second.
    pub velocity_m_s: InFrame<F>,
}

impl<F: Frame> RelativeState<F> {
    /// The same state in other axes that rotate with these.
    #[must_use]
    pub fn rotated<To: Frame>(&self, to_from_here: Rotation<To, F>) -> RelativeState<To> {
        RelativeState {
            position_m: to_from_here * self.position_m,
            velocity_m_s: to_from_here * self.velocity_m_s,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lvlh_axes_point_where_ccsds_says() {
        let along_track = RTN_FROM_LVLH_CCSDS * InFrame::new(Vector3::x());
        let minus_normal = RTN_FROM_LVLH_CCSDS * InFrame::new(Vector3::y());
        let nadir = RTN_FROM_LVLH_CCSDS * InFrame::new(Vector3::z());
        assert_eq!(along_track.components, Vector3::new(0.0, 1.0, 0.0));
        assert_eq!(minus_normal.components, Vector3::new(0.0, 0.0, -1.0));
        assert_eq!(nadir.components, Vector3::new(-1.0, 0.0, 0.0));
    }

    #[test]
    fn rotation_there_and_back_is_exact() {
        let p = InFrame::<Rtn>::new(Vector3::new(1.25, -7.5, 0.375));
        let back = RTN_FROM_LVLH_CCSDS * (RTN_FROM_LVLH_CCSDS.inverse() * p);
        assert_eq!(back, p);
        assert_eq!(RTN_FROM_LVLH_CCSDS.matrix.determinant(), 1.0);
    }
}
