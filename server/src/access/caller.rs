//! Who asks.

use std::{
    fmt,
    net::{IpAddr, Ipv6Addr},
    sync::Arc,
};

/// What a caller may ask for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) enum Role {
    /// Compute, upload, read and export plans.
    Plan,
    /// Decide steps, and ask what could be done if thrusters failed.
    Step,
    /// Make artifacts and read them, follow and cancel operations.
    Precompute,
    /// Everything.
    Admin,
}

impl Role {
    /// Every role.
    pub(crate) const ALL: [Self; 4] = [Self::Plan, Self::Step, Self::Precompute, Self::Admin];

    /// Its name, in files and in errors.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Plan => "plan",
            Self::Step => "step",
            Self::Precompute => "precompute",
            Self::Admin => "admin",
        }
    }
}

/// The roles of one caller.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Roles(u8);

impl Roles {
    /// Every role.
    pub(crate) const ALL: Self = Self(0b1111);

    /// Whether a caller with these roles may do what needs `role`.
    pub(crate) fn allow(self, role: Role) -> bool {
        self.0 & (bit(role) | bit(Role::Admin)) != 0
    }
}

impl FromIterator<Role> for Roles {
    fn from_iter<T: IntoIterator<Item = Role>>(roles: T) -> Self {
        Self(roles.into_iter().fold(0, |bits, role| bits | bit(role)))
    }
}

fn bit(role: Role) -> u8 {
    match role {
        Role::Plan => 1,
        Role::Step => 1 << 1,
        Role::Precompute => 1 << 2,
        Role::Admin => 1 << 3,
    }
}

/// Who asks: the name of a token or certificate, or the address where nobody is asked for one.
///
/// Two calls are of one caller if their names are equal. Cheap to clone.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Caller {
    name: Arc<str>,
    roles: Roles,
}

impl Caller {
    /// The caller that a token or certificate names.
    pub(crate) fn named(name: Arc<str>, roles: Roles) -> Self {
        Self { name, roles }
    }

    /// Whoever is at `address`.
    ///
    /// One machine can have a whole IPv6 network of 64 bits (RFC 4291, sec. 2.5.1), so its
    /// addresses count as one caller.
    pub(crate) fn at(address: IpAddr, roles: Roles) -> Self {
        let name = match address.to_canonical() {
            IpAddr::V6(address) if !address.is_loopback() => {
                let [a, b, c, d, ..] = address.segments();
                format!("{}/64", Ipv6Addr::new(a, b, c, d, 0, 0, 0, 0))
            }
            address => address.to_string(),
        };
        Self { name: name.into(), roles }
    }

    /// Its name.
    pub(crate) fn name(&self) -> &Arc<str> {
        &self.name
    }

    /// What it may ask for.
    pub(crate) fn roles(&self) -> Roles {
        self.roles
    }
}

impl fmt::Display for Caller {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn caller_at_an_address_is_named_by_it_and_a_network_is_one_caller() {
        for (address, name) in [
            ("10.0.0.7", "10.0.0.7"),
            ("::ffff:10.0.0.7", "10.0.0.7"),
            ("::1", "::1"),
            ("2001:db8:1:2:3:4:5:6", "2001:db8:1:2::/64"),
            ("2001:db8:1:2::1", "2001:db8:1:2::/64"),
        ] {
            let caller = Caller::at(address.parse().unwrap(), Roles::ALL);
            assert_eq!(&**caller.name(), name);
        }
    }

    #[test]
    fn roles_allow_their_own_and_admin_allows_all() {
        for role in Role::ALL {
            assert!(Roles::from_iter([role]).allow(role));
            assert!(Roles::from_iter([Role::Admin]).allow(role));
            assert!(!Roles::default().allow(role));
        }
        assert!(!Roles::from_iter([Role::Plan, Role::Step]).allow(Role::Precompute));
        assert!(!Roles::from_iter([Role::Plan, Role::Step, Role::Precompute]).allow(Role::Admin));
        assert_eq!(Roles::from_iter(Role::ALL), Roles::ALL);
    }
}
