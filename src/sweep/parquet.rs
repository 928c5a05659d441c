//! The rows of a sweep as a Parquet file.

use recorder_proc::parquet_table::{self, Column};
use serde_json::Value;

use super::row::{FIGURES, Row};
use crate::failure::Failure;

/// Builds the table: `point`, a column for each key, `outcome`, `reason`, `final_hash`, the results, `log`,
/// `command`. A key whose values are all numbers has a numeric column, any other a text column.
pub fn table(keys: &[String], rows: &[Row]) -> Result<Vec<u8>, Failure> {
    let mut columns =
        vec![("point".to_owned(), Column::Integers(rows.iter().map(|row| row.point as i64).collect()))];
    for (place, key) in keys.iter().enumerate() {
        let value = |row: &Row| row.parameters.get(place).map(|(_, value)| value.clone());
        columns.push((key.clone(), of_values(&rows.iter().map(value).collect::<Vec<_>>())));
    }
    let texts = |of: fn(&Row) -> Option<String>| Column::Texts(rows.iter().map(of).collect());
    columns.push(("outcome".to_owned(), texts(|row| Some(row.outcome.name().to_owned()))));
    columns.push(("reason".to_owned(), texts(|row| row.reason.clone())));
    columns.push(("final_hash".to_owned(), texts(|row| row.final_hash.clone())));
    for (name, of) in FIGURES {
        columns.push((name.to_owned(), Column::Numbers(rows.iter().map(of).collect())));
    }
    columns.push(("log".to_owned(), texts(|row| row.log.as_ref().map(|log| log.display().to_string()))));
    columns.push(("command".to_owned(), texts(|row| Some(row.command.clone()))));
    let table = parquet_table::table("sweep", &columns);
    table.map_err(|cause| Failure::failed(format!("the table cannot be created: {cause}")))
}

fn of_values(values: &[Option<Value>]) -> Column {
    if values.iter().flatten().all(Value::is_number) {
        return Column::Numbers(values.iter().map(|value| value.as_ref().and_then(Value::as_f64)).collect());
    }
    let text = |value: &Value| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
    Column::Texts(values.iter().map(|value| value.as_ref().map(text)).collect())
}
