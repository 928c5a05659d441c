//! Parquet: flat columns of numbers.

use std::path::Path;

use foreign_text::{foreign, foreign_path};
use parquet::column::reader::{ColumnReader, ColumnReaderImpl};
use parquet::data_type::DataType;
use parquet::errors::ParquetError;
use parquet::file::reader::{FileReader, SerializedFileReader};

use super::{MAX_ROWS, no_column, opened, too_long};
use crate::failure::Failure;

/// Rows that are decoded at a time.
const ROWS_AT_ONCE: usize = 1 << 14;

/// Reads columns by name.
pub(super) fn read(file: &Path, wanted: &[&str]) -> Result<Vec<Vec<f64>>, Failure> {
    let malformed = |cause: ParquetError| {
        Failure::bad_input(format!("{}: not a readable Parquet file ({cause})", foreign_path(file)))
    };
    let reader = SerializedFileReader::new(opened(file)?).map_err(malformed)?;
    let metadata = reader.metadata();
    if !usize::try_from(metadata.file_metadata().num_rows()).is_ok_and(|rows| rows <= MAX_ROWS) {
        return Err(too_long(file));
    }
    let schema = metadata.file_metadata().schema_descr();
    let names: Vec<String> = schema.columns().iter().map(|column| column.path().string()).collect();
    let known: Vec<&str> = names.iter().map(String::as_str).collect();
    let mut columns = Vec::new();
    for name in wanted {
        let place = known.iter().position(|known| known == name);
        let place = place.ok_or_else(|| no_column(file, name, &known))?;
        if schema.column(place).max_rep_level() > 0 {
            let why = format!("column `{}` is a list, expected a number in each row", foreign(name));
            return Err(Failure::bad_input(format!("{}: {why}", foreign_path(file))));
        }
        let most = schema.column(place).max_def_level();
        let mut column = Vec::new();
        for group in 0..reader.num_row_groups() {
            let group = reader.get_row_group(group).map_err(malformed)?;
            let read = group.get_column_reader(place).map_err(malformed)?;
            let is_number = append(read, most, &mut column).map_err(malformed)?;
            if !is_number {
                let why = format!("column `{}` holds no numbers", foreign(name));
                return Err(Failure::bad_input(format!("{}: {why}", foreign_path(file))));
            }
        }
        columns.push(column);
    }
    Ok(columns)
}

/// Appends a column of any numeric type; false if it has another type.
fn append(reader: ColumnReader, most: i16, out: &mut Vec<f64>) -> Result<bool, ParquetError> {
    match reader {
        ColumnReader::BoolColumnReader(it) => values(it, most, out, |x| f64::from(u8::from(*x)))?,
        ColumnReader::Int32ColumnReader(it) => values(it, most, out, |x| f64::from(*x))?,
        ColumnReader::Int64ColumnReader(it) => values(it, most, out, |x| *x as f64)?,
        ColumnReader::FloatColumnReader(it) => values(it, most, out, |x| f64::from(*x))?,
        ColumnReader::DoubleColumnReader(it) => values(it, most, out, |x| *x)?,
        _ => return Ok(false),
    }
    Ok(true)
}

fn values<T: DataType>(
    mut reader: ColumnReaderImpl<T>,
    most: i16,
    out: &mut Vec<f64>,
    of: fn(&T::T) -> f64,
) -> Result<(), ParquetError> {
    loop {
        let (mut values, mut levels) = (Vec::new(), Vec::new());
        let (records, _, _) = reader.read_records(ROWS_AT_ONCE, Some(&mut levels), None, &mut values)?;
        if records == 0 {
            return Ok(());
        }
        let mut next = values.iter();
        match most {
            0 => out.extend(next.map(of)),
            _ => out.extend(levels.iter().map(|level| match *level == most {
                true => next.next().map_or(f64::NAN, of),
                false => f64::NAN,
            })),
        }
    }
}
