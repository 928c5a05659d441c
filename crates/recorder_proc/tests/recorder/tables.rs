//! Fields of a log as CSV and Parquet.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

use crate::common::*;
use messages::{Tick, TickRange};
use parquet::file::reader::{FileReader, SerializedFileReader};
use parquet::record::Field;
use recorder_proc::log_file::LogFile;
use recorder_proc::parquet_file::Parquet;
use run_log::columns::{Column, Rows, columns, description_of_topic, read_rows};
use run_log::csv::Csv;

const FIELDS: [&str; 4] = ["tick", "t_world_link[7].position_m", "hash", "removed_in_tick"];

fn states(steps: &[Step]) -> Vec<ipc_types::messages::State> {
    let states = steps.iter().filter_map(|step| if let Step::State(s) = step { Some(**s) } else { None });
    states.collect()
}

fn fields() -> Vec<String> {
    FIELDS.map(str::to_owned).to_vec()
}

#[test]
fn a_csv_has_a_line_a_message_and_a_column_a_number() {
    let folder = tempfile::tempdir().unwrap();
    let steps = run_messages(120, None);
    let path = save(folder.path(), "run.mcap", &write_log(&steps));
    let description = description_of_topic(&LogFile::at(&path), "/state").unwrap();
    let columns = columns(description, &fields()).unwrap();
    let mut text = Vec::new();
    let mut rows = Csv::new(&mut text, &columns).unwrap();
    read_rows(
        &LogFile::at(&path),
        "/state",
        &columns,
        TickRange { first: Tick(10), last: Some(Tick(99)) },
        &mut rows,
    )
    .unwrap();
    rows.finish().unwrap();
    let text = String::from_utf8(text).unwrap();
    let mut lines = text.lines();
    let names = "log_tick,log_time_ns,tick,t_world_link[7].position_m[0],t_world_link[7].position_m[1],\
                 t_world_link[7].position_m[2],hash[0],hash[1],removed_in_tick";
    assert_eq!(lines.next().unwrap(), names);
    let wanted = states(&steps);
    let mut count = 0;
    for (line, state) in lines.zip(&wanted[10..]) {
        let cells: Vec<&str> = line.split(',').collect();
        assert_eq!(cells[0].parse::<u64>().unwrap(), state.tick);
        assert_eq!(cells[1].parse::<u64>().unwrap(), state.tick * 1_000_000);
        for (cell, value) in cells[3..6].iter().zip(state.t_world_link[7].position_m) {
            assert_eq!(cell.parse::<f64>().unwrap().to_bits(), value.to_bits());
        }
        assert_eq!(cells[6].parse::<u64>().unwrap(), state.hash[0]);
        assert_eq!(cells[8].parse::<u32>().unwrap(), state.removed_in_tick);
        count += 1;
    }
    assert_eq!(count, 90);
}

/// Reads the values back with the parquet crate; `ecosystem` reads them with other libraries.
#[test]
fn a_parquet_file_holds_the_same_numbers() {
    let folder = tempfile::tempdir().unwrap();
    let steps = run_messages(300, None);
    let path = save(folder.path(), "run.mcap", &write_log(&steps));
    let columns: Vec<Column> =
        columns(description_of_topic(&LogFile::at(&path), "/state").unwrap(), &fields()).unwrap();
    let out = folder.path().join("state.parquet");
    let mut rows = Parquet::new(std::fs::File::create(&out).unwrap(), &columns).unwrap();
    read_rows(&LogFile::at(&path), "/state", &columns, TickRange::ALL, &mut rows).unwrap();
    rows.finish().unwrap();
    let reader = SerializedFileReader::new(std::fs::File::open(&out).unwrap()).unwrap();
    assert_eq!(reader.metadata().file_metadata().num_rows(), 301);
    for (row, state) in reader.get_row_iter(None).unwrap().zip(states(&steps)) {
        let values: Vec<Field> = row.unwrap().get_column_iter().map(|(_, value)| value.clone()).collect();
        assert_eq!(values[0], Field::Long(state.tick as i64));
        for (value, wanted) in values[3..6].iter().zip(state.t_world_link[7].position_m) {
            assert!(matches!(value, Field::Double(value) if value.to_bits() == wanted.to_bits()));
        }
        assert_eq!(values[7], Field::ULong(state.hash[1]));
    }
}

#[test]
fn what_is_not_there_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = save(folder.path(), "run.mcap", &write_log(&run_messages(20, None)));
    let error = description_of_topic(&LogFile::at(&path), "/stat").unwrap_err().to_string();
    assert!(error.contains("no topic /stat") && error.contains("/state"), "{error}");
    let description = description_of_topic(&LogFile::at(&path), "/state").unwrap();
    let error = columns(description, &["tip_mm".to_owned()]).unwrap_err().to_string();
    assert!(error.contains("tip_mm"), "{error}");
    // All fields of a state, including every scalar of every pose.
    let all = columns(description, &[]).unwrap();
    let size = |column: &Column| match column.ros_type {
        "float64" | "uint64" => 8,
        "uint32" => 4,
        other => panic!("{}: {other}", column.name),
    };
    assert_eq!(all.iter().map(size).sum::<usize>(), description.size);
    assert!(all.iter().any(|column| column.name == "t_world_link[26].orientation_xyzw[3]"));
}
