//! A codec that refuses unknown fields in requests.
//!
//! `prost` drops fields it does not know. For guidance that is dangerous: an old server must not
//! ignore a new client's keep-out zone. Answers stay lenient, so that an old client can read a
//! new server.

use std::marker::PhantomData;

use prost::{
    Message, Name,
    bytes::Buf,
    encoding::{WireType, decode_key, decode_varint},
};
use prost_reflect::{Kind, MessageDescriptor};
use tonic::{
    Status,
    codec::{Codec, DecodeBuf, Decoder},
};
use tonic_prost::ProstCodec;

use crate::DESCRIPTORS;

/// Nesting deeper than this is left to `prost`, which refuses it at 100.
const DEPTH_MAX: usize = 100;

/// A field that the contract does not know.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UnknownField {
    /// Path of the message that carries it; empty for the request itself.
    pub path: String,
    /// Its field number.
    pub number: u32,
}

/// The first unknown field in the encoded `bytes` of a `message`, if any.
///
/// Malformed bytes are not judged here: decoding reports them.
#[must_use]
pub fn find_unknown_field(message: &MessageDescriptor, bytes: &[u8]) -> Option<UnknownField> {
    scan(message, bytes, DEPTH_MAX)
}

fn scan(message: &MessageDescriptor, mut bytes: &[u8], depth: usize) -> Option<UnknownField> {
    while bytes.has_remaining() {
        let (number, wire_type) = decode_key(&mut bytes).ok()?;
        let Some(field) = message.get_field(number) else {
            return Some(UnknownField { path: String::new(), number });
        };
        let length = match wire_type {
            WireType::Varint => {
                decode_varint(&mut bytes).ok()?;
                continue;
            }
            WireType::ThirtyTwoBit => 4,
            WireType::SixtyFourBit => 8,
            WireType::LengthDelimited => usize::try_from(decode_varint(&mut bytes).ok()?).ok()?,
            WireType::StartGroup | WireType::EndGroup => return None,
        };
        let body = bytes.get(..length)?;
        bytes = &bytes[length..];
        if let (Kind::Message(inner), WireType::LengthDelimited) = (field.kind(), wire_type)
            && depth > 0
            && let Some(mut found) = scan(&inner, body, depth - 1)
        {
            let dot = if found.path.is_empty() { "" } else { "." };
            found.path = format!("{}{dot}{}", field.name(), found.path);
            return Some(found);
        }
    }
    None
}

/// `ProstCodec` that refuses unknown fields in messages whose name ends in `Request`.
#[derive(Debug)]
pub struct StrictCodec<T, U>(PhantomData<(T, U)>);

impl<T, U> Default for StrictCodec<T, U> {
    fn default() -> Self {
        Self(PhantomData)
    }
}

impl<T, U> Codec for StrictCodec<T, U>
where
    T: Message + Send + 'static,
    U: Message + Name + Default + Send + 'static,
{
    type Encode = T;
    type Decode = U;
    type Encoder = <ProstCodec<T, U> as Codec>::Encoder;
    type Decoder = StrictDecoder<U>;

    fn encoder(&mut self) -> Self::Encoder {
        ProstCodec::<T, U>::default().encoder()
    }

    fn decoder(&mut self) -> Self::Decoder {
        let strict = U::NAME.ends_with("Request");
        let descriptor =
            if strict { DESCRIPTORS.get_message_by_name(&U::full_name()) } else { None };
        StrictDecoder { descriptor, message: PhantomData }
    }
}

/// Decoder of [`StrictCodec`].
#[derive(Debug)]
pub struct StrictDecoder<U> {
    descriptor: Option<MessageDescriptor>,
    message: PhantomData<U>,
}

impl<U: Message + Default> Decoder for StrictDecoder<U> {
    type Item = U;
    type Error = Status;

    fn decode(&mut self, source: &mut DecodeBuf<'_>) -> Result<Option<U>, Status> {
        let bytes = source.copy_to_bytes(source.remaining());
        if let Some(descriptor) = &self.descriptor
            && let Some(unknown) = find_unknown_field(descriptor, &bytes)
        {
            return Err(Status::invalid_argument(unknown.to_string()));
        }
        U::decode(bytes)
            .map(Some)
            .map_err(|fault| Status::invalid_argument(format!("malformed message: {fault}")))
    }
}

impl std::fmt::Display for UnknownField {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let place = if self.path.is_empty() { "the request" } else { &self.path };
        write!(f, "unknown field number {} in {place}: this server does not know it", self.number)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::v1::{Measurement, RelativeState, StepRequest, measurement};

    fn request() -> StepRequest {
        StepRequest {
            measurement: Some(Measurement {
                state: Some(measurement::State::Relative(RelativeState {
                    frame: 1,
                    position_m: vec![1.0, 2.0, 3.0],
                    velocity_m_s: vec![0.0; 3],
                })),
                elapsed_s: Some(0.0),
                working_thrusters: None,
            }),
            ..StepRequest::default()
        }
    }

    fn descriptor() -> MessageDescriptor {
        DESCRIPTORS.get_message_by_name("vbar.v1.StepRequest").expect("it is in the contract")
    }

    #[test]
    fn unknown_field_none_in_a_known_request() {
        assert_eq!(find_unknown_field(&descriptor(), &request().encode_to_vec()), None);
    }

    #[test]
    fn unknown_field_found_with_its_path() {
        // A keep-out zone from the future: field 77 inside measurement.relative.
        let mut relative = request().measurement.unwrap().state.map_or(vec![], |s| match s {
            measurement::State::Relative(r) => r.encode_to_vec(),
            measurement::State::Linear(_) => vec![],
        });
        relative.extend([0xe8, 0x04, 0x01]); // key 77 << 3 | 0, value 1
        let mut measurement = vec![0x0a, u8::try_from(relative.len()).unwrap()];
        measurement.extend(&relative);
        let mut bytes = vec![0x22, u8::try_from(measurement.len()).unwrap()];
        bytes.extend(&measurement);
        let found = find_unknown_field(&descriptor(), &bytes).expect("field 77 is unknown");
        assert_eq!(found, UnknownField { path: "measurement.relative".into(), number: 77 });
    }

    #[test]
    fn unknown_field_truncated_bytes_are_left_to_decoding() {
        let bytes = request().encode_to_vec();
        for length in 0..bytes.len() {
            assert_eq!(find_unknown_field(&descriptor(), &bytes[..length]), None, "{length}");
        }
    }
}
