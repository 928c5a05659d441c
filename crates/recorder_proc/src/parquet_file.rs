//! Writes tables as Parquet files. Kept out of `run_log` because the `parquet` crate pulls in system
//! randomness and dates.

use std::io::Write;
use std::sync::Arc;

use ipc_types::messages::Tick;

use parquet::basic::{Compression, LogicalType, Repetition, Type as PhysicalType};
use parquet::data_type::{DoubleType, FloatType, Int64Type};
use parquet::errors::ParquetError;
use parquet::file::properties::WriterProperties;
use parquet::file::writer::SerializedFileWriter;
use parquet::schema::types::{Type, TypePtr};

use run_log::LogError;
use run_log::columns::{Column, LOG_COLUMNS, Rows};
use run_log::fields::Scalar;

/// Rows per Parquet row group: a minute of ticks.
const ROW_GROUP: usize = 65_536;

/// A Parquet file: integers as INT64, those of 64 bits without a sign marked so, floats as FLOAT and DOUBLE.
pub struct Parquet<W: Write + Send> {
    writer: SerializedFileWriter<W>,
    columns: Vec<Values>,
}

enum Values {
    Int64(Vec<i64>),
    Float(Vec<f32>),
    Double(Vec<f64>),
}

impl Values {
    fn of(ros_type: &str) -> Values {
        match ros_type {
            "float64" => Values::Double(Vec::new()),
            "float32" => Values::Float(Vec::new()),
            _ => Values::Int64(Vec::new()),
        }
    }

    fn physical(&self) -> PhysicalType {
        match self {
            Values::Int64(_) => PhysicalType::INT64,
            Values::Float(_) => PhysicalType::FLOAT,
            Values::Double(_) => PhysicalType::DOUBLE,
        }
    }

    fn push(&mut self, value: Scalar) {
        match self {
            Values::Int64(values) => values.push(value.bits() as i64),
            Values::Float(values) => values.push(f32::from_bits(value.bits() as u32)),
            Values::Double(values) => values.push(f64::from_bits(value.bits())),
        }
    }

    fn clear(&mut self) {
        match self {
            Values::Int64(values) => values.clear(),
            Values::Float(values) => values.clear(),
            Values::Double(values) => values.clear(),
        }
    }
}

fn parquet_error(error: ParquetError) -> LogError {
    let source = match error {
        // Unwrap a disk error, to report it unchanged.
        ParquetError::External(cause) => match cause.downcast::<std::io::Error>() {
            Ok(cause) => *cause,
            Err(other) => std::io::Error::other(other),
        },
        other => std::io::Error::other(other),
    };
    LogError::Output { source }
}

impl<W: Write + Send> Parquet<W> {
    /// Starts the file.
    ///
    /// # Errors
    /// Any error of the output.
    pub fn new(out: W, columns: &[Column]) -> Result<Parquet<W>, LogError> {
        let named = columns.iter().map(|column| (column.name.as_str(), column.ros_type));
        let time = LOG_COLUMNS.map(|name| (name, "int64"));
        let (mut fields, mut values) = (Vec::new(), Vec::new());
        for (name, ros_type) in time.into_iter().chain(named) {
            let empty = Values::of(ros_type);
            // Without it a reader takes the upper half, where many hashes are, for negative numbers.
            let unsigned = (ros_type == "uint64").then(|| LogicalType::integer(64, false));
            let field = Type::primitive_type_builder(name, empty.physical()).with_logical_type(unsigned);
            let field = field.with_repetition(Repetition::REQUIRED).build().map_err(parquet_error)?;
            fields.push(TypePtr::from(field));
            values.push(empty);
        }
        let schema = Type::group_type_builder("log").with_fields(fields).build().map_err(parquet_error)?;
        let properties = WriterProperties::builder().set_compression(Compression::UNCOMPRESSED).build();
        let writer = SerializedFileWriter::new(out, Arc::new(schema), Arc::new(properties));
        Ok(Parquet { writer: writer.map_err(parquet_error)?, columns: values })
    }

    fn rows_held(&self) -> usize {
        match self.columns.first() {
            Some(Values::Int64(values)) => values.len(),
            _ => 0,
        }
    }

    fn write_group(&mut self) -> Result<(), ParquetError> {
        if self.rows_held() == 0 {
            return Ok(());
        }
        let mut group = self.writer.next_row_group()?;
        for values in &mut self.columns {
            let Some(mut column) = group.next_column()? else { break };
            match values {
                Values::Int64(values) => {
                    column.typed::<Int64Type>().write_batch(values, None, None)?;
                }
                Values::Float(values) => {
                    column.typed::<FloatType>().write_batch(values, None, None)?;
                }
                Values::Double(values) => {
                    column.typed::<DoubleType>().write_batch(values, None, None)?;
                }
            }
            column.close()?;
            values.clear();
        }
        group.close().map(|_| ())
    }
}

impl<W: Write + Send> Rows for Parquet<W> {
    fn row(&mut self, tick: Tick, log_time_ns: u64, values: &[Scalar]) -> Result<(), LogError> {
        let time = [tick.0, log_time_ns].map(Scalar::Unsigned);
        for (column, value) in self.columns.iter_mut().zip(time.iter().chain(values)) {
            column.push(*value);
        }
        if self.rows_held() == ROW_GROUP { self.write_group().map_err(parquet_error) } else { Ok(()) }
    }

    /// Writes the last rows and the footer.
    fn finish(&mut self) -> Result<(), LogError> {
        self.write_group().and_then(|()| self.writer.finish().map(|_| ())).map_err(parquet_error)
    }
}
