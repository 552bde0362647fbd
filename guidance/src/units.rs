//! Quantities at the border: a number with its unit cannot be mistaken for another.
//!
//! Inside formulas plain `f64` in SI units and radians are used, and names say so.

macro_rules! quantity {
    ($(#[$doc:meta])* $name:ident: $from:ident / $to:ident in $unit:literal) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, PartialOrd)]
        pub struct $name(f64);

        impl $name {
            #[doc = concat!("From ", $unit, ".")]
            #[must_use]
            pub const fn $from(value: f64) -> Self {
                Self(value)
            }

            #[doc = concat!("In ", $unit, ".")]
            #[must_use]
            pub const fn $to(self) -> f64 {
                self.0
            }
        }
    };
}

quantity! {
    /// A plane angle.
    Angle: from_radians / radians in "radians"
}
quantity! {
    /// A length.
    Distance: from_metres / metres in "metres"
}
quantity! {
    /// A mass.
    Mass: from_kilograms / kilograms in "kilograms"
}
quantity! {
    /// A duration.
    Seconds: from_seconds / seconds in "seconds"
}
quantity! {
    /// An acceleration.
    Acceleration: from_m_s2 / m_s2 in "metres per second squared"
}
quantity! {
    /// A force.
    Force: from_newtons / newtons in "newtons"
}

impl Angle {
    /// From degrees.
    #[must_use]
    pub fn from_degrees(degrees: f64) -> Self {
        Self(degrees * (std::f64::consts::PI / 180.0))
    }

    /// In degrees.
    #[must_use]
    pub fn degrees(self) -> f64 {
        self.0 * (180.0 / std::f64::consts::PI)
    }
}

impl std::ops::Mul<Acceleration> for Mass {
    type Output = Force;

    fn mul(self, acceleration: Acceleration) -> Force {
        Force(self.0 * acceleration.0)
    }
}
