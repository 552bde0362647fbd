//! Where messages begin and end in a body.

/// How far the reading of a body is.
#[derive(Debug)]
pub(super) enum Framing {
    /// The body is one message.
    Whole,
    /// Each message comes after a byte of flags and its length in four bytes, as in gRPC.
    Prefixed { head: [u8; 5], read: usize, left: u32 },
}

/// What a piece of a body holds, in its order.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Part<'a> {
    /// A message begins.
    Begin,
    /// Bytes of it.
    Bytes(&'a [u8]),
    /// All of it was there.
    End,
}

impl Framing {
    /// Nothing was read yet.
    pub(super) fn new(is_grpc: bool) -> Self {
        if is_grpc { Self::Prefixed { head: [0; 5], read: 0, left: 0 } } else { Self::Whole }
    }

    /// A message was begun, and is not all there.
    pub(super) fn is_within(&self) -> bool {
        matches!(self, Self::Prefixed { read, left, .. } if *read > 0 || *left > 0)
    }

    /// Lets `take` have what `bytes`, the next of the body, hold. A body that is one message has
    /// neither begin nor end.
    pub(super) fn split(&mut self, mut bytes: &[u8], mut take: impl FnMut(Part<'_>)) {
        let Self::Prefixed { head, read, left } = self else {
            take(Part::Bytes(bytes));
            return;
        };
        while let Some((&first, rest)) = bytes.split_first() {
            if *left > 0 {
                let length = bytes.len().min(usize::try_from(*left).unwrap_or(usize::MAX));
                take(Part::Bytes(&bytes[..length]));
                *left -= u32::try_from(length).unwrap_or(*left);
                bytes = &bytes[length..];
                if *left == 0 {
                    take(Part::End);
                }
                continue;
            }
            head[*read] = first;
            *read += 1;
            bytes = rest;
            if *read == head.len() {
                *left = u32::from_be_bytes([head[1], head[2], head[3], head[4]]);
                *read = 0;
                take(Part::Begin);
                if *left == 0 {
                    take(Part::End);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_are_the_same_however_the_body_is_cut() {
        let messages = [b"abc".as_slice(), b"", &[7; 300]];
        let body: Vec<u8> = messages
            .iter()
            .flat_map(|message| {
                let length = u32::try_from(message.len()).unwrap().to_be_bytes();
                [&[0], &length[..], *message].concat()
            })
            .collect();
        for piece in [1, 2, 3, 5, 7, 64, body.len()] {
            let (mut framing, mut read, mut open) = (Framing::new(true), Vec::new(), None);
            for bytes in body.chunks(piece) {
                framing.split(bytes, |part| match part {
                    Part::Begin => assert_eq!(open.replace(Vec::new()), None),
                    Part::Bytes(bytes) => open.as_mut().unwrap().extend_from_slice(bytes),
                    Part::End => read.push(open.take().unwrap()),
                });
            }
            assert_eq!(read, messages, "in pieces of {piece}");
            assert!(!framing.is_within());
        }
    }

    #[test]
    fn half_a_message_is_known_from_its_first_byte() {
        let mut framing = Framing::new(true);
        assert!(!framing.is_within());
        for byte in [0, 0, 0, 0, 2, 1] {
            framing.split(&[byte], |part| assert_ne!(part, Part::End));
            assert!(framing.is_within());
        }
        framing.split(&[1], |_| {});
        assert!(!framing.is_within());
    }
}
