//! Tables as comma-separated values.

use std::io::Write;

use crate::columns::{Column, Rows};
use crate::error::LogError;
use crate::fields::Scalar;

/// Comma-separated values with a line of names. Floats have as many digits as identify them.
pub struct Csv<W: Write>(W);

impl<W: Write> Csv<W> {
    /// Writes the names.
    ///
    /// # Errors
    /// What the output says.
    pub fn new(mut out: W, columns: &[Column]) -> Result<Csv<W>, LogError> {
        let names: Vec<&str> = columns.iter().map(|column| column.name.as_str()).collect();
        writeln!(out, "tick,log_time_ns{}{}", if names.is_empty() { "" } else { "," }, names.join(","))?;
        Ok(Csv(out))
    }

    /// Writes what is held back.
    ///
    /// # Errors
    /// What the output says.
    pub fn finish(mut self) -> Result<(), LogError> {
        Ok(self.0.flush()?)
    }
}

impl<W: Write> Rows for Csv<W> {
    fn row(&mut self, tick: u64, log_time_ns: u64, values: &[Scalar]) -> Result<(), LogError> {
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
}
