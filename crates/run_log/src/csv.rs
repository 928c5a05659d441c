//! Writes tables as comma-separated values.

use std::io::Write;

use messages::Tick;

use crate::columns::{Column, LOG_COLUMNS, Rows};
use crate::error::LogError;
use crate::fields::Scalar;

/// A CSV writer with a header line. Floats are printed with just enough digits to round-trip.
pub struct Csv<W: Write>(W);

impl<W: Write> Csv<W> {
    /// Writes the header line.
    ///
    /// # Errors
    /// Any error of the output.
    pub fn new(mut out: W, columns: &[Column]) -> Result<Csv<W>, LogError> {
        let names: Vec<&str> = columns.iter().map(|column| column.name.as_str()).collect();
        writeln!(out, "{}", [&LOG_COLUMNS, names.as_slice()].concat().join(","))?;
        Ok(Csv(out))
    }
}

impl<W: Write> Rows for Csv<W> {
    fn row(&mut self, tick: Tick, log_time_ns: u64, values: &[Scalar]) -> Result<(), LogError> {
        write!(self.0, "{tick},{log_time_ns}")?;
        for value in values {
            match value {
                Scalar::Unsigned(value) => write!(self.0, ",{value}")?,
                Scalar::Signed(value) => write!(self.0, ",{value}")?,
                Scalar::Float32(value) => write!(self.0, ",{value:e}")?,
                Scalar::Float64(value) => write!(self.0, ",{value:e}")?,
            }
        }
        Ok(writeln!(self.0)?)
    }

    fn finish(&mut self) -> Result<(), LogError> {
        Ok(self.0.flush()?)
    }
}
