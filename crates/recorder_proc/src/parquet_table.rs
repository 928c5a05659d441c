//! Builds whole tables as Parquet files in memory.

use std::sync::Arc;

use parquet::basic::{Compression, LogicalType, Repetition, Type as PhysicalType};
use parquet::data_type::{ByteArray, ByteArrayType, DoubleType, Int64Type};
use parquet::errors::ParquetError;
use parquet::file::properties::WriterProperties;
use parquet::file::writer::SerializedFileWriter;
use parquet::schema::types::{Type, TypePtr};

/// A column; missing values are null.
pub enum Column {
    /// Integers, one for each row.
    Integers(Vec<i64>),
    /// Numbers.
    Numbers(Vec<Option<f64>>),
    /// Strings.
    Texts(Vec<Option<String>>),
}

fn field(name: &str, column: &Column) -> Result<TypePtr, ParquetError> {
    let (physical, logical, repetition) = match column {
        Column::Integers(_) => (PhysicalType::INT64, None, Repetition::REQUIRED),
        Column::Numbers(_) => (PhysicalType::DOUBLE, None, Repetition::OPTIONAL),
        Column::Texts(_) => (PhysicalType::BYTE_ARRAY, Some(LogicalType::String), Repetition::OPTIONAL),
    };
    let builder = Type::primitive_type_builder(name, physical).with_logical_type(logical);
    Ok(TypePtr::from(builder.with_repetition(repetition).build()?))
}

/// Encodes a table of these columns, by name.
///
/// # Errors
/// Any error of the `parquet` library.
pub fn table(name: &str, columns: &[(String, Column)]) -> Result<Vec<u8>, ParquetError> {
    let fields = columns.iter().map(|(name, column)| field(name, column)).collect::<Result<_, _>>()?;
    let schema = Arc::new(Type::group_type_builder(name).with_fields(fields).build()?);
    let properties = Arc::new(WriterProperties::builder().set_compression(Compression::UNCOMPRESSED).build());
    let mut bytes = Vec::new();
    let mut writer = SerializedFileWriter::new(&mut bytes, schema, properties)?;
    let mut group = writer.next_row_group()?;
    for (_, column) in columns {
        let Some(mut out) = group.next_column()? else { break };
        match column {
            Column::Integers(values) => {
                out.typed::<Int64Type>().write_batch(values, None, None)?;
            }
            Column::Numbers(values) => {
                let (there, levels) = apart(values, |value| *value);
                out.typed::<DoubleType>().write_batch(&there, Some(&levels), None)?;
            }
            Column::Texts(values) => {
                let (there, levels) = apart(values, |text| ByteArray::from(text.as_str()));
                out.typed::<ByteArrayType>().write_batch(&there, Some(&levels), None)?;
            }
        }
        out.close()?;
    }
    group.close()?;
    writer.close()?;
    Ok(bytes)
}

/// Returns the values present, and for each row whether it has one.
fn apart<T, U>(values: &[Option<T>], of: impl Fn(&T) -> U) -> (Vec<U>, Vec<i16>) {
    let levels = values.iter().map(|value| i16::from(value.is_some())).collect();
    (values.iter().flatten().map(of).collect(), levels)
}
