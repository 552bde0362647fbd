//! Fresh tokens.

use rustls::crypto::ring;

use super::{
    Role,
    files::{digest, hexadecimal},
    tokens::{is_name, moment},
};
use crate::telemetry::TOKEN_PREFIX;

/// A token that nobody has seen yet.
pub struct NewToken {
    /// The token: for its holder only.
    pub secret: String,
    /// The entry for the file of tokens, with the digest only.
    pub entry: String,
}

impl NewToken {
    /// Draws a token for `name`, with `roles`, until `expires` (RFC 3339) if it is given.
    ///
    /// # Errors
    /// Everything that is wrong with the arguments, or the system that gives no random numbers.
    pub fn draw(name: &str, roles: &[String], expires: Option<&str>) -> Result<Self, Vec<String>> {
        let mut faults = Vec::new();
        if !is_name(name) {
            let expected = "1 to 64 of a-z, A-Z, 0-9, '.', '_' and '-', and no address";
            faults.push(format!("name: expected {expected}, got {name:?}"));
        }
        for role in roles {
            if !Role::ALL.iter().any(|known| known.name() == role) {
                faults
                    .push(format!("role: expected plan, step, precompute or admin, got {role:?}"));
            }
        }
        if let Some(text) = expires
            && text.parse().ok().and_then(moment).is_none()
        {
            let expected = "a date and time with an offset, such as 2027-03-01T00:00:00Z";
            faults.push(format!("expires: expected {expected}, got {text:?}"));
        }
        let mut random = [0; 32];
        if ring::default_provider().secure_random.fill(&mut random).is_err() {
            faults.push("the system gives no random numbers".to_owned());
        }
        if !faults.is_empty() {
            return Err(faults);
        }
        let secret = format!("{TOKEN_PREFIX}{}", hexadecimal(&random));
        let sha256 = hexadecimal(&digest(secret.as_bytes()));
        let roles: Vec<_> = roles.iter().map(|role| format!("\"{role}\"")).collect();
        let mut entry = format!(
            "[[token]]\nname = \"{name}\"\nsha256 = \"{sha256}\"\nroles = [{}]\n",
            roles.join(", ")
        );
        if let Some(expires) = expires {
            entry.push_str(&format!("expires = {expires}\n"));
        }
        Ok(Self { secret, entry })
    }
}

#[cfg(test)]
mod tests {
    use std::time::SystemTime;

    use super::*;
    use crate::access::{
        AccessOptions,
        tokens::{Shown, Tokens},
    };

    #[test]
    fn token_drawn_is_known_by_its_entry_and_no_two_are_alike() {
        let draw = || {
            let roles = ["plan".to_owned(), "step".to_owned()];
            NewToken::draw("ground-1", &roles, Some("2126-01-01T00:00:00Z")).unwrap()
        };
        let (token, other) = (draw(), draw());
        assert_ne!(token.secret, other.secret);
        assert!(!token.entry.contains(&token.secret[TOKEN_PREFIX.len()..]));
        let text = format!("{}{}", token.entry, other.entry);
        let tokens = Tokens::read(text.as_bytes(), AccessOptions::default().rate(), None).unwrap();
        let entry = tokens.find(Shown::Token, &digest(token.secret.as_bytes())).unwrap();
        assert_eq!(&**entry.caller.name(), "ground-1");
        assert!(entry.caller.roles().allow(Role::Step));
        assert!(!entry.caller.roles().allow(Role::Admin));
        assert!(!entry.has_expired(SystemTime::now()));
    }

    #[test]
    fn token_arguments_faults_are_all_named() {
        let faults = NewToken::draw("two words", &["root".to_owned()], Some("soon"));
        let faults = faults.err().unwrap();
        let named: Vec<_> = faults.iter().map(|f| f.split(':').next().unwrap()).collect();
        assert_eq!(named, ["name", "role", "expires"]);
    }
}
