//! Canonical bytes: our own fixed little-endian encoding of parsed values.
//!
//! Digests name problems and artifacts, so equal values must give equal bytes in every build;
//! no general format promises that.

use nalgebra::{DMatrix, DVector, Vector3};

/// Why bytes could not be read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("at byte {offset}: {what}")]
pub struct DecodeError {
    /// Where.
    pub offset: usize,
    /// What was wrong.
    pub what: String,
}

/// Appends values.
#[derive(Debug, Default)]
pub(crate) struct Writer {
    bytes: Vec<u8>,
    keeps_sign_of_zero: bool,
}

/// Takes values back, never beyond the end and never more than was announced.
#[derive(Debug)]
pub(crate) struct Reader<'a> {
    bytes: &'a [u8],
    offset: usize,
}

/// Longest list accepted when reading; far above any limit of a valid artifact.
const COUNT_MAX: usize = 50_000_000;

impl Writer {
    /// Every number comes back bit by bit, for what is computed on and not compared.
    pub(crate) fn exact() -> Self {
        Self { bytes: Vec::new(), keeps_sign_of_zero: true }
    }

    pub(crate) fn finish(self) -> Vec<u8> {
        self.bytes
    }

    /// The bytes and a checksum, CRC-32 of all before it; [`Reader::unsealed`] looks at it first.
    pub(crate) fn seal(mut self) -> Vec<u8> {
        let checksum = crc32(&self.bytes);
        self.bytes.extend(checksum.to_le_bytes());
        self.bytes
    }

    pub(crate) fn tag(&mut self, tag: u8) {
        self.bytes.push(tag);
    }

    pub(crate) fn count(&mut self, count: usize) {
        self.bytes.extend((count as u64).to_le_bytes());
    }

    pub(crate) fn integer(&mut self, value: i64) {
        self.bytes.extend(value.to_le_bytes());
    }

    /// Counts of two bytes each, for indices that travel often; larger ones are saturated, and
    /// readers check what indices they get.
    pub(crate) fn small_counts(&mut self, counts: &[usize]) {
        let small = |count: usize| u16::try_from(count).unwrap_or(u16::MAX);
        self.bytes.extend(small(counts.len()).to_le_bytes());
        counts.iter().for_each(|&count| self.bytes.extend(small(count).to_le_bytes()));
    }

    pub(crate) fn number(&mut self, value: f64) {
        // One zero: -0.0 and 0.0 mean the same problem.
        let value = if value == 0.0 && !self.keeps_sign_of_zero { 0.0 } else { value };
        self.bytes.extend(value.to_le_bytes());
    }

    pub(crate) fn numbers(&mut self, values: &[f64]) {
        self.count(values.len());
        values.iter().for_each(|&value| self.number(value));
    }

    pub(crate) fn vector3(&mut self, value: &Vector3<f64>) {
        value.iter().for_each(|&x| self.number(x));
    }

    pub(crate) fn matrix(&mut self, matrix: &DMatrix<f64>) {
        self.count(matrix.nrows());
        self.count(matrix.ncols());
        matrix.iter().for_each(|&x| self.number(x));
    }

    pub(crate) fn option<T>(&mut self, value: Option<T>, write: impl FnOnce(&mut Self, T)) {
        match value {
            None => self.tag(0),
            Some(value) => {
                self.tag(1);
                write(self, value);
            }
        }
    }

    pub(crate) fn bytes(&mut self, bytes: &[u8]) {
        self.count(bytes.len());
        self.bytes.extend_from_slice(bytes);
    }
}

impl<'a> Reader<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, offset: 0 }
    }

    /// Reads what [`Writer::seal`] wrote, if nothing changed it on the way; `go_on` is asked now and
    /// then.
    pub(crate) fn unsealed<E: From<DecodeError>>(
        bytes: &'a [u8],
        go_on: impl Fn() -> Result<(), E>,
    ) -> Result<Self, E> {
        const BLOCK: usize = 1 << 16;
        let end = bytes.len().saturating_sub(size_of::<u32>());
        let (body, checksum) = bytes.split_at(end);
        let mut register = u32::MAX;
        for block in body.chunks(BLOCK) {
            go_on()?;
            register = crc32_moved_on(register, block);
        }
        if checksum != (!register).to_le_bytes() {
            let what = "the checksum differs: the bytes were changed on the way".into();
            return Err(DecodeError { offset: end, what }.into());
        }
        Ok(Self::new(body))
    }

    pub(crate) fn fault(&self, what: impl Into<String>) -> DecodeError {
        DecodeError { offset: self.offset, what: what.into() }
    }

    /// A tag that no `what` has.
    pub(crate) fn unknown(&self, what: &str, tag: u8) -> DecodeError {
        self.fault(format!("{what} {tag} is not known"))
    }

    /// Fails if anything is left.
    pub(crate) fn end(&self) -> Result<(), DecodeError> {
        match self.bytes.len() - self.offset {
            0 => Ok(()),
            left => Err(self.fault(format!("{left} bytes left over"))),
        }
    }

    fn take(&mut self, length: usize) -> Result<&'a [u8], DecodeError> {
        let end = self.offset.checked_add(length).filter(|&end| end <= self.bytes.len());
        let end = end.ok_or_else(|| self.fault(format!("{length} bytes expected, end found")))?;
        let taken = &self.bytes[self.offset..end];
        self.offset = end;
        Ok(taken)
    }

    pub(crate) fn tag(&mut self) -> Result<u8, DecodeError> {
        Ok(self.take(1)?[0])
    }

    pub(crate) fn count(&mut self) -> Result<usize, DecodeError> {
        let mut raw = [0; 8];
        raw.copy_from_slice(self.take(8)?);
        usize::try_from(u64::from_le_bytes(raw))
            .ok()
            .filter(|&count| count <= COUNT_MAX)
            .ok_or_else(|| self.fault("count too large"))
    }

    pub(crate) fn integer(&mut self) -> Result<i64, DecodeError> {
        let mut raw = [0; 8];
        raw.copy_from_slice(self.take(8)?);
        Ok(i64::from_le_bytes(raw))
    }

    pub(crate) fn small_counts(&mut self) -> Result<Vec<usize>, DecodeError> {
        let mut next = || -> Result<usize, DecodeError> {
            let mut raw = [0; 2];
            raw.copy_from_slice(self.take(2)?);
            Ok(u16::from_le_bytes(raw).into())
        };
        let count = next()?;
        (0..count).map(|_| next()).collect()
    }

    pub(crate) fn number(&mut self) -> Result<f64, DecodeError> {
        let mut raw = [0; 8];
        raw.copy_from_slice(self.take(8)?);
        let value = f64::from_le_bytes(raw);
        if value.is_finite() { Ok(value) } else { Err(self.fault("number is not finite")) }
    }

    fn exactly(&mut self, count: usize) -> Result<Vec<f64>, DecodeError> {
        if count.saturating_mul(8) > self.bytes.len() - self.offset {
            return Err(self.fault(format!("{count} numbers announced, fewer found")));
        }
        (0..count).map(|_| self.number()).collect()
    }

    pub(crate) fn numbers(&mut self) -> Result<Vec<f64>, DecodeError> {
        let count = self.count()?;
        self.exactly(count)
    }

    pub(crate) fn vector(&mut self) -> Result<DVector<f64>, DecodeError> {
        self.numbers().map(DVector::from_vec)
    }

    pub(crate) fn vector3(&mut self) -> Result<Vector3<f64>, DecodeError> {
        Ok(Vector3::new(self.number()?, self.number()?, self.number()?))
    }

    pub(crate) fn matrix(&mut self) -> Result<DMatrix<f64>, DecodeError> {
        let (rows, columns) = (self.count()?, self.count()?);
        let count = rows.checked_mul(columns).ok_or_else(|| self.fault("matrix too large"))?;
        Ok(DMatrix::from_vec(rows, columns, self.exactly(count)?))
    }

    pub(crate) fn option<T>(
        &mut self,
        read: impl FnOnce(&mut Self) -> Result<T, DecodeError>,
    ) -> Result<Option<T>, DecodeError> {
        match self.tag()? {
            0 => Ok(None),
            1 => read(self).map(Some),
            other => Err(self.fault(format!("0 or 1 expected, {other} found"))),
        }
    }

    pub(crate) fn bytes(&mut self) -> Result<&'a [u8], DecodeError> {
        let count = self.count()?;
        self.take(count)
    }
}

/// CRC-32 as in IEEE 802.3 and ZIP: reflected polynomial 0xEDB88320, all ones before and after.
/// Finds every change of one bit, and every burst of up to 32.
fn crc32(bytes: &[u8]) -> u32 {
    !crc32_moved_on(u32::MAX, bytes)
}

/// The register after these bytes too.
fn crc32_moved_on(register: u32, bytes: &[u8]) -> u32 {
    bytes.iter().fold(register, |register, &byte| {
        (register >> 8) ^ CRC32_OF_BYTE[(register as u8 ^ byte) as usize]
    })
}

/// What eight steps of the register make of each lowest byte.
const CRC32_OF_BYTE: [u32; 256] = {
    let mut table = [0; 256];
    let mut byte = 0;
    while byte < 256 {
        let mut register = byte as u32;
        let mut bit = 0;
        while bit < 8 {
            register = (register >> 1) ^ (0xEDB8_8320 * (register & 1));
            bit += 1;
        }
        table[byte] = register;
        byte += 1;
    }
    table
};

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_come_back_and_truncation_is_found() {
        let matrix = DMatrix::from_row_slice(2, 3, &[1.0, -2.5, 3.0, 0.0, 1e-300, -0.0]);
        let mut writer = Writer::default();
        writer.tag(7);
        writer.count(12);
        writer.matrix(&matrix);
        writer.option(Some(2.5), Writer::number);
        writer.option(None::<f64>, Writer::number);
        writer.bytes(b"abc");
        let bytes = writer.finish();
        let read = |bytes: &[u8]| -> Result<(), DecodeError> {
            let mut reader = Reader::new(bytes);
            assert_eq!(reader.tag()?, 7);
            assert_eq!(reader.count()?, 12);
            assert_eq!(reader.matrix()?, matrix);
            assert_eq!(reader.option(Reader::number)?, Some(2.5));
            assert_eq!(reader.option(Reader::number)?, None);
            assert_eq!(reader.bytes()?, b"abc");
            reader.end()
        };
        assert_eq!(read(&bytes), Ok(()));
        for length in 1..bytes.len() {
            assert!(read(&bytes[..length]).is_err(), "{length} of {} bytes", bytes.len());
        }
    }

    #[test]
    fn checksum_has_the_standards_check_value() {
        assert_eq!(crc32(b"123456789"), 0xCBF4_3926);
    }

    #[test]
    fn announced_length_is_not_believed() {
        let mut writer = Writer::default();
        writer.count(40_000_000);
        let bytes = writer.finish();
        assert!(Reader::new(&bytes).numbers().is_err());
    }
}
