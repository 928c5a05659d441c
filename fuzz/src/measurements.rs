//! Measured tables of others, as CSV.

use identify::study::Source;
use inputs::measurements::read;

use crate::volume::in_memory;

/// Reads the bytes as a table. An accepted one gives columns of equal lengths.
pub fn measurements(data: &[u8]) {
    let own = |text: &str| text.to_owned();
    let (file, time_unit) = (in_memory("measured.csv", data), own("ms"));
    let source = Source { file, topic: None, time: Some(own("t")), time_unit };
    match read(&source, &["x", "", "z"].map(own)) {
        Ok(rows) => {
            let is_full = |column: &Vec<f64>| column.len() == rows.times_s.len();
            assert!(rows.columns.len() == 3 && rows.columns.iter().all(is_full));
        }
        Err(failure) => assert_eq!(failure.code, 2, "{}", failure.message),
    }
}

/// Seeds: a table with each separator.
pub fn seeds() -> Vec<Vec<u8>> {
    let tables = [
        "t,x,z\n0,1.5,2\n10,,3\n",
        "\u{feff}# comment\r\n\"t\";\"z\";\"x\"\r\n0;2;1,5\r\n10;3;NaN\r\n",
        "z\tt\tunused\tx\n2\t0\tword\t1.5\n\n3\t10\tword\n",
    ];
    tables.map(|table| table.as_bytes().to_vec()).to_vec()
}
