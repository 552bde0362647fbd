//! Canonical proto3 JSON of the contract's messages, and standard output.

use std::io::{self, Write as _};

use prost_reflect::{
    DeserializeOptions, DynamicMessage, SerializeOptions,
    prost::{Message, Name},
};
use vbar_proto::DESCRIPTORS;

use crate::failure::Failure;

/// Reads one message; unknown fields are refused.
pub(crate) fn parse<M: Message + Name + Default>(text: &str) -> Result<M, Failure> {
    let descriptor = DESCRIPTORS
        .get_message_by_name(&M::full_name())
        .ok_or_else(|| Failure::ours(format!("{} is not in the contract", M::full_name())))?;
    let refused = |fault: serde_json::Error| Failure::data(format!("not a {}: {fault}", M::NAME));
    let mut reader = serde_json::Deserializer::from_str(text);
    let options = DeserializeOptions::new().deny_unknown_fields(true);
    let message = DynamicMessage::deserialize_with_options(descriptor, &mut reader, &options)
        .map_err(refused)?;
    reader.end().map_err(refused)?;
    message.transcode_to().map_err(|fault| Failure::ours(fault.to_string()))
}

/// Renders one message, indented.
pub(crate) fn render<M: Message + Name>(message: &M) -> Result<String, Failure> {
    let ours = |fault: String| Failure::ours(format!("{} as JSON: {fault}", M::NAME));
    let descriptor = DESCRIPTORS
        .get_message_by_name(&M::full_name())
        .ok_or_else(|| ours("not in the contract".into()))?;
    let mut dynamic = DynamicMessage::new(descriptor);
    dynamic.transcode_from(message).map_err(|fault| ours(fault.to_string()))?;
    let mut bytes = Vec::new();
    let mut writer = serde_json::Serializer::pretty(&mut bytes);
    dynamic
        .serialize_with_options(&mut writer, &SerializeOptions::new())
        .map_err(|fault| ours(fault.to_string()))?;
    String::from_utf8(bytes).map_err(|fault| ours(fault.to_string()))
}

/// Prints `text` and a line end. A reader that has seen enough (`vbar … | head`) is no failure.
pub(crate) fn print(text: &str) -> Result<(), Failure> {
    let mut out = io::stdout().lock();
    match writeln!(out, "{text}").and_then(|()| out.flush()) {
        Err(fault) if fault.kind() != io::ErrorKind::BrokenPipe => {
            Err(Failure::cannot_write(format!("standard output: {fault}")))
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use vbar_proto::v1::{StepRequest, StepResponse};

    use super::*;

    #[test]
    fn message_survives_its_json() {
        let text = r#"{"artifactId": "a", "measurement": {"elapsed_s": 0.5}}"#;
        let request: StepRequest = parse(text).unwrap();
        assert_eq!(request.measurement.as_ref().unwrap().elapsed_s, Some(0.5));
        let again: StepRequest = parse(&render(&request).unwrap()).unwrap();
        assert_eq!(again, request);
    }

    #[test]
    fn json_that_is_not_the_message_is_refused_with_its_place() {
        for (text, part) in [
            ("{\"artifactId\": \"a\",\n \"speed\": 3}", "speed"),
            ("{\"artifactId\": ", "line 1"),
            ("{} {}", "trailing"),
            ("[]", "StepRequest"),
        ] {
            let failure = parse::<StepRequest>(text).unwrap_err();
            assert!(failure.to_string().contains(part), "{failure}");
            assert_eq!(failure.code, 65);
        }
    }

    #[test]
    fn absent_numbers_are_left_out() {
        assert_eq!(render(&StepResponse::default()).unwrap(), "{}");
    }
}
