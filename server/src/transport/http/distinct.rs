//! No field of a JSON object may be given twice: which of the two a reader takes is nobody's to
//! guess (RFC 8259, sec. 4), and the other would be dropped without a word.

use std::{borrow::Cow, collections::HashSet, fmt};

use serde::de::{Deserialize, Deserializer, Error as _, MapAccess, SeqAccess, Visitor};

/// Every object in `text` names each of its fields once, in either spelling.
///
/// # Errors
/// The first that does not, or whatever makes the text no JSON, with line and column.
pub(super) fn fields(text: &[u8]) -> Result<(), serde_json::Error> {
    let mut reader = serde_json::Deserializer::from_slice(text);
    Distinct::deserialize(&mut reader).map(|Distinct| ())
}

/// Any value, of which nothing is kept.
struct Distinct;

impl<'de> Deserialize<'de> for Distinct {
    fn deserialize<D: Deserializer<'de>>(reader: D) -> Result<Self, D::Error> {
        reader.deserialize_any(Values)
    }
}

struct Values;

impl<'de> Visitor<'de> for Values {
    type Value = Distinct;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a value")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Distinct, A::Error> {
        let mut seen = HashSet::new();
        while let Some(name) = map.next_key::<Cow<'de, str>>()? {
            if !seen.insert(lower_camel(name)) {
                return Err(A::Error::custom("a field is given twice"));
            }
            map.next_value::<Distinct>()?;
        }
        Ok(Distinct)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Distinct, A::Error> {
        while list.next_element::<Distinct>()?.is_some() {}
        Ok(Distinct)
    }

    fn visit_unit<E>(self) -> Result<Distinct, E> {
        Ok(Distinct)
    }

    fn visit_bool<E>(self, _: bool) -> Result<Distinct, E> {
        Ok(Distinct)
    }

    fn visit_i64<E>(self, _: i64) -> Result<Distinct, E> {
        Ok(Distinct)
    }

    fn visit_u64<E>(self, _: u64) -> Result<Distinct, E> {
        Ok(Distinct)
    }

    fn visit_f64<E>(self, _: f64) -> Result<Distinct, E> {
        Ok(Distinct)
    }

    fn visit_str<E>(self, _: &str) -> Result<Distinct, E> {
        Ok(Distinct)
    }
}

/// The name that canonical JSON has for a field of the contract: without underscores, the letters
/// behind them large.
fn lower_camel(name: Cow<'_, str>) -> Cow<'_, str> {
    if !name.contains('_') {
        return name;
    }
    let mut camel = String::with_capacity(name.len());
    let mut is_behind = false;
    for letter in name.chars() {
        match letter {
            '_' => is_behind = true,
            letter if is_behind => {
                camel.push(letter.to_ascii_uppercase());
                is_behind = false;
            }
            letter => camel.push(letter),
        }
    }
    camel.into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn field_given_twice_is_found_wherever_it_is() {
        for (text, is_good) in [
            (r#"{"a": 1, "b": [{"a": 2}, {"a": 3}], "c": {"a": null}}"#, true),
            (r#"{"a": 1, "a": 1}"#, false),
            (r#"{"a": 1, "\u0061": 1}"#, false),
            (r#"{"position_m": 1, "positionM": 1}"#, false),
            (r#"{"position_m": 1, "positionm": 1}"#, true),
            (r#"{"b": [[{"a": 1, "x": {}, "a": 2}]]}"#, false),
            ("[1, -2, 3.5, true, null, \"x\"]", true),
        ] {
            assert_eq!(fields(text.as_bytes()).is_ok(), is_good, "{text}");
        }
    }
}
