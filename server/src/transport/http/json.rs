//! Canonical proto3 JSON.

use prost::{Message, Name};
use prost_reflect::{DeserializeOptions, DynamicMessage, MessageDescriptor, SerializeOptions};
use vbar_proto::DESCRIPTORS;

use super::distinct;
use crate::service::{Code, Error};

/// Reads a message; unknown fields and fields given twice are refused, the first fault is named
/// with line and column.
pub(crate) fn decode<M: Message + Name + Default>(text: &[u8]) -> Result<M, Error> {
    let options = DeserializeOptions::new().deny_unknown_fields(true);
    let mut reader = serde_json::Deserializer::from_slice(text);
    let read = distinct::fields(text).and_then(|()| {
        let message =
            DynamicMessage::deserialize_with_options(descriptor::<M>(), &mut reader, &options)?;
        reader.end().map(|()| message)
    });
    let message = read.map_err(|fault| {
        Error::new(Code::InvalidArgument, "MALFORMED_JSON", format!("malformed JSON: {fault}"))
    })?;
    message.transcode_to().map_err(|fault| Error::internal("TRANSCODING", &fault.to_string()))
}

/// Writes a message; fields with default values are written too, so that a reader need not know
/// the contract to see a `false` or a 0.
pub(crate) fn encode<M: Message + Name>(message: &M) -> Vec<u8> {
    let options = SerializeOptions::new().skip_default_fields(false);
    let mut dynamic = DynamicMessage::new(descriptor::<M>());
    dynamic.transcode_from(message).expect("a message fits its own descriptor");
    let mut text = Vec::with_capacity(4096);
    let mut writer = serde_json::Serializer::new(&mut text);
    dynamic
        .serialize_with_options(&mut writer, &options)
        .expect("every Any in an answer is of a type in the contract");
    text
}

fn descriptor<M: Name>() -> MessageDescriptor {
    DESCRIPTORS.get_message_by_name(&M::full_name()).expect("the message is in the contract")
}

#[cfg(test)]
mod tests {
    use vbar_proto::v1::{self, measurement::State};

    use super::*;

    const MEASUREMENT: &str = r#"{"relative": {"frame": "FRAME_RTN",
        "positionM": [1, 2.5, -3e2], "velocity_m_s": [0, 0, 0]}, "elapsedS": 0}"#;

    #[test]
    fn json_takes_both_spellings_and_round_trips() {
        let measurement: v1::Measurement = decode(MEASUREMENT.as_bytes()).unwrap();
        let Some(State::Relative(relative)) = &measurement.state else { panic!("relative") };
        assert_eq!(relative.position_m, [1.0, 2.5, -300.0]);
        assert_eq!(relative.velocity_m_s, [0.0; 3]);
        // Absent is not 0: this 0 was given.
        assert_eq!(measurement.elapsed_s, Some(0.0));
        assert_eq!(decode::<v1::Measurement>(&encode(&measurement)).unwrap(), measurement);
    }

    #[test]
    fn json_fault_is_named_with_line_and_column() {
        for (text, named) in [
            ("{\"relative\": {\n\"frame\": \"FRAME_LVLH\"}}", "line 2"),
            ("{\"elapsedS\": 1, \"keepOut\": {}}", "keepOut"),
            ("{\"elapsedS\": 1", "EOF"),
            ("{\"elapsedS\": NaN}", "line 1 column"),
            ("{\"elapsedS\": 1} x", "trailing"),
            ("{\"elapsedS\": 1,\n\"elapsed_s\": 1}", "line 2"),
            ("", "EOF"),
        ] {
            let fault = decode::<v1::Measurement>(text.as_bytes()).unwrap_err();
            assert_eq!(fault.code, Code::InvalidArgument);
            assert!(fault.message.contains(named), "{text}: {}", fault.message);
            assert!(fault.message.contains("column"), "{text}: {}", fault.message);
        }
    }

    #[test]
    fn json_shows_false_and_zero_but_not_what_is_absent() {
        let text = String::from_utf8(encode(&v1::Command::default())).unwrap();
        assert!(text.contains("\"last\":false"), "{text}");
        assert!(!text.contains("durationS"), "{text}");
    }
}
