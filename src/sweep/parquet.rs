//! The rows of a sweep as a Parquet file.

use std::sync::Arc;

use parquet::basic::{Compression, LogicalType, Repetition, Type as PhysicalType};
use parquet::data_type::{ByteArray, ByteArrayType, DoubleType, Int64Type};
use parquet::errors::ParquetError;
use parquet::file::properties::WriterProperties;
use parquet::file::writer::SerializedFileWriter;
use parquet::schema::types::{Type, TypePtr};
use serde_json::Value;

use super::row::{FIGURES, Row};
use crate::failure::Failure;

/// A column; what a row has not is null.
enum Column {
    Integers(Vec<i64>),
    Numbers(Vec<Option<f64>>),
    Texts(Vec<Option<String>>),
}

/// The table: `point`, a column for each key, `outcome`, `reason`, `final_hash`, the figures, `log`, `command`. A key whose values are all
/// numbers gives numbers, any other one texts.
///
/// # Errors
/// The library's.
pub fn table(keys: &[String], rows: &[Row]) -> Result<Vec<u8>, Failure> {
    let mut columns =
        vec![("point".to_owned(), Column::Integers(rows.iter().map(|row| row.point as i64).collect()))];
    for (place, key) in keys.iter().enumerate() {
        let value = |row: &Row| row.parameters.get(place).map(|(_, value)| value.clone());
        let values: Vec<Option<Value>> = rows.iter().map(value).collect();
        columns.push((key.clone(), of_values(&values)));
    }
    let texts = |of: fn(&Row) -> Option<String>| Column::Texts(rows.iter().map(of).collect());
    columns.push(("outcome".to_owned(), texts(|row| Some(row.outcome.name().to_owned()))));
    columns.push(("reason".to_owned(), texts(|row| row.reason.clone())));
    columns.push(("final_hash".to_owned(), texts(|row| row.final_hash.clone())));
    for (place, name) in FIGURES.iter().enumerate() {
        let numbers = rows.iter().map(|row| row.figures()[place]).collect();
        columns.push(((*name).to_owned(), Column::Numbers(numbers)));
    }
    columns.push(("log".to_owned(), texts(|row| row.log.as_ref().map(|log| log.display().to_string()))));
    columns.push(("command".to_owned(), texts(|row| Some(row.command.clone()))));
    write(&columns).map_err(|cause| Failure::failed(format!("the table cannot be made: {cause}")))
}

fn of_values(values: &[Option<Value>]) -> Column {
    if values.iter().flatten().all(Value::is_number) {
        return Column::Numbers(values.iter().map(|value| value.as_ref().and_then(Value::as_f64)).collect());
    }
    let text = |value: &Value| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
    Column::Texts(values.iter().map(|value| value.as_ref().map(text)).collect())
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

fn write(columns: &[(String, Column)]) -> Result<Vec<u8>, ParquetError> {
    let fields = columns.iter().map(|(name, column)| field(name, column)).collect::<Result<_, _>>()?;
    let schema = Arc::new(Type::group_type_builder("sweep").with_fields(fields).build()?);
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

/// The values that are there, and for each row whether there is one.
fn apart<T, U>(values: &[Option<T>], of: impl Fn(&T) -> U) -> (Vec<U>, Vec<i16>) {
    let levels = values.iter().map(|value| i16::from(value.is_some())).collect();
    (values.iter().flatten().map(of).collect(), levels)
}
