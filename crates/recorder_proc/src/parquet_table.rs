//! Builds tables as Parquet files.

use std::io::Write;
use std::sync::Arc;

use parquet::basic::{Compression, LogicalType, Repetition, Type as PhysicalType};
use parquet::data_type::{BoolType, ByteArray, ByteArrayType, DataType, DoubleType, FloatType, Int64Type};
pub use parquet::errors::ParquetError;
use parquet::file::metadata::KeyValue;
use parquet::file::properties::WriterProperties;
use parquet::file::writer::{SerializedFileWriter, SerializedRowGroupWriter};
use parquet::schema::types::{Type, TypePtr};

/// A column; missing values are null.
pub enum Column {
    /// Integers, one for each row.
    Integers(Vec<i64>),
    /// Numbers.
    Numbers(Vec<Option<f64>>),
    /// Strings.
    Texts(Vec<Option<String>>),
    /// Numbers of single precision, one for each row.
    Floats(Vec<f32>),
    /// True or false, one for each row.
    Flags(Vec<bool>),
    /// Lists of as many numbers of single precision in each row; the values of all rows.
    FloatLists(usize, Vec<f32>),
    /// A list of numbers in each row.
    NumberLists(Vec<Vec<f64>>),
    /// A list of strings in each row.
    TextLists(Vec<Vec<String>>),
    /// An encoded picture in each row, as a group of `bytes` and `path`, which is null.
    Pictures(Vec<Vec<u8>>),
}

fn field(name: &str, column: &Column) -> Result<TypePtr, ParquetError> {
    let scalar = |name: &str, physical, logical, repetition| {
        let builder = Type::primitive_type_builder(name, physical).with_logical_type(logical);
        Ok::<_, ParquetError>(TypePtr::from(builder.with_repetition(repetition).build()?))
    };
    let group = |name: &str, logical, repetition, of: Vec<TypePtr>| {
        let builder = Type::group_type_builder(name).with_logical_type(logical).with_fields(of);
        Ok::<_, ParquetError>(TypePtr::from(builder.with_repetition(repetition).build()?))
    };
    // A list as Parquet's LogicalTypes.md defines it, with three levels.
    let list = |physical, logical| {
        let element = scalar("element", physical, logical, Repetition::REQUIRED)?;
        let repeated = group("list", None, Repetition::REPEATED, vec![element])?;
        group(name, Some(LogicalType::List), Repetition::REQUIRED, vec![repeated])
    };
    let (required, optional) = (Repetition::REQUIRED, Repetition::OPTIONAL);
    match column {
        Column::Integers(_) => scalar(name, PhysicalType::INT64, None, required),
        Column::Numbers(_) => scalar(name, PhysicalType::DOUBLE, None, optional),
        Column::Texts(_) => scalar(name, PhysicalType::BYTE_ARRAY, Some(LogicalType::String), optional),
        Column::Floats(_) => scalar(name, PhysicalType::FLOAT, None, required),
        Column::Flags(_) => scalar(name, PhysicalType::BOOLEAN, None, required),
        Column::FloatLists(..) => list(PhysicalType::FLOAT, None),
        Column::NumberLists(_) => list(PhysicalType::DOUBLE, None),
        Column::TextLists(_) => list(PhysicalType::BYTE_ARRAY, Some(LogicalType::String)),
        Column::Pictures(_) => {
            let bytes = scalar("bytes", PhysicalType::BYTE_ARRAY, None, optional)?;
            let path = scalar("path", PhysicalType::BYTE_ARRAY, Some(LogicalType::String), optional)?;
            group(name, None, required, vec![bytes, path])
        }
    }
}

/// Encodes a table of these columns, by name.
///
/// # Errors
/// Any error of the `parquet` library.
pub fn table(name: &str, columns: &[(String, Column)]) -> Result<Vec<u8>, ParquetError> {
    let mut writer = TableWriter::new(Vec::new(), name, columns, &[])?;
    writer.rows(columns)?;
    writer.end()
}

/// A table being written, a group of rows at a time.
pub struct TableWriter<W: Write + Send>(SerializedFileWriter<W>);

impl<W: Write + Send> TableWriter<W> {
    /// Starts a table with the names and kinds of these columns, and metadata of the file as keys and values.
    ///
    /// # Errors
    /// Any error of the `parquet` library or the output.
    pub fn new(
        out: W,
        name: &str,
        columns: &[(String, Column)],
        metadata: &[(&str, String)],
    ) -> Result<TableWriter<W>, ParquetError> {
        let fields = columns.iter().map(|(name, column)| field(name, column)).collect::<Result<_, _>>()?;
        let schema = Arc::new(Type::group_type_builder(name).with_fields(fields).build()?);
        let pairs: Vec<KeyValue> =
            metadata.iter().map(|(key, value)| KeyValue::new((*key).to_owned(), value.clone())).collect();
        let properties = WriterProperties::builder()
            .set_compression(Compression::UNCOMPRESSED)
            .set_key_value_metadata((!pairs.is_empty()).then_some(pairs))
            .build();
        Ok(TableWriter(SerializedFileWriter::new(out, schema, Arc::new(properties))?))
    }

    /// Writes a group of rows.
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub fn rows(&mut self, columns: &[(String, Column)]) -> Result<(), ParquetError> {
        let mut group = self.0.next_row_group()?;
        for (_, column) in columns {
            write(&mut group, column)?;
        }
        group.close().map(|_| ())
    }

    /// Writes the footer and returns the output.
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub fn end(self) -> Result<W, ParquetError> {
        self.0.into_inner()
    }
}

fn write<W: Write + Send>(
    group: &mut SerializedRowGroupWriter<'_, W>,
    column: &Column,
) -> Result<(), ParquetError> {
    match column {
        Column::Integers(values) => put::<Int64Type, _>(group, values, None, None),
        Column::Numbers(values) => {
            let (there, levels) = apart(values, |value| *value);
            put::<DoubleType, _>(group, &there, Some(&levels), None)
        }
        Column::Texts(values) => {
            let (there, levels) = apart(values, |text| ByteArray::from(text.as_str()));
            put::<ByteArrayType, _>(group, &there, Some(&levels), None)
        }
        Column::Floats(values) => put::<FloatType, _>(group, values, None, None),
        Column::Flags(values) => put::<BoolType, _>(group, values, None, None),
        Column::FloatLists(width, values) => {
            let starts: Vec<i16> = (0..values.len()).map(|i| i16::from(i % width.max(&1) != 0)).collect();
            put::<FloatType, _>(group, values, Some(&vec![1; values.len()]), Some(&starts))
        }
        Column::NumberLists(rows) => {
            let (there, levels, starts) = lists(rows, |value| *value);
            put::<DoubleType, _>(group, &there, Some(&levels), Some(&starts))
        }
        Column::TextLists(rows) => {
            let (there, levels, starts) = lists(rows, |text| ByteArray::from(text.as_str()));
            put::<ByteArrayType, _>(group, &there, Some(&levels), Some(&starts))
        }
        Column::Pictures(values) => {
            let bytes: Vec<ByteArray> = values.iter().map(|bytes| ByteArray::from(bytes.clone())).collect();
            put::<ByteArrayType, _>(group, &bytes, Some(&vec![1; bytes.len()]), None)?;
            put::<ByteArrayType, _>(group, &[], Some(&vec![0; bytes.len()]), None)
        }
    }
}

/// Writes the next column: its values, and the levels of definition and repetition where it has any.
fn put<T: DataType, W: Write + Send>(
    group: &mut SerializedRowGroupWriter<'_, W>,
    values: &[T::T],
    definition: Option<&[i16]>,
    repetition: Option<&[i16]>,
) -> Result<(), ParquetError> {
    let Some(mut out) = group.next_column()? else { return Ok(()) };
    out.typed::<T>().write_batch(values, definition, repetition)?;
    out.close()
}

/// Returns the values present, and for each row whether it has one.
fn apart<T, U>(values: &[Option<T>], of: impl Fn(&T) -> U) -> (Vec<U>, Vec<i16>) {
    let levels = values.iter().map(|value| i16::from(value.is_some())).collect();
    (values.iter().flatten().map(of).collect(), levels)
}

/// Returns the elements of all rows, and for each whether it exists (an empty list has one that does not) and
/// whether it continues a list.
fn lists<T, U>(rows: &[Vec<T>], of: impl Fn(&T) -> U) -> (Vec<U>, Vec<i16>, Vec<i16>) {
    let slots = || rows.iter().flat_map(|row| (0..row.len().max(1)).map(move |i| (i, row.is_empty())));
    let levels = slots().map(|(_, is_empty)| i16::from(!is_empty)).collect();
    (rows.iter().flatten().map(of).collect(), levels, slots().map(|(i, _)| i16::from(i > 0)).collect())
}
