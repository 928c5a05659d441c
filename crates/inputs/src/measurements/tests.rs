use std::path::PathBuf;

use identify::study::Source;
use recorder_proc::parquet_table::{Column, table};

use super::*;

fn source(file: PathBuf, topic: Option<&str>, time: Option<&str>, unit: &str) -> Source {
    let own = |text: &str| text.to_owned();
    Source { file, topic: topic.map(own), time: time.map(own), time_unit: own(unit) }
}

fn names(names: &[&str]) -> Vec<String> {
    names.iter().map(|name| (*name).to_owned()).collect()
}

/// Numbers as text, so that missing ones compare.
fn said(rows: &Rows) -> String {
    format!("{:?} {:?}", rows.times_s, rows.columns)
}

#[test]
fn csv_files_of_any_common_dialect_give_the_same_rows() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("a.csv");
    for text in [
        "t,x,y\n0,1.5,2\n10,,3\n",
        "\u{feff}# comment\r\n\"t\";\"y\";\"x\"\r\n0;2;1,5\r\n10;3;NaN\r\n",
        "y\tt\tunused\tx\n2\t0\tword\t1.5\n\n3\t10\tword\n",
    ] {
        std::fs::write(&file, text).unwrap();
        let rows = read(&source(file.clone(), None, Some("t"), "ms"), &names(&["x", "", "y"])).unwrap();
        assert_eq!(said(&rows), "[0.0, 0.01] [[1.5, NaN], [NaN, NaN], [2.0, 3.0]]", "{text}");
    }
}

#[test]
fn bad_csv_files_are_refused_by_line_and_column() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("a.csv");
    for (text, part) in [
        ("t,tip_x\n1,2\n", "no column `tip_y`"),
        ("t,tip_x\n1,2\n", "(did you mean `tip_x`?); it has t, tip_x"),
        ("t,tip_y\n1,two\n", "line 2: column 2 is `two`, expected a number"),
        ("", "no header line"),
    ] {
        std::fs::write(&file, text).unwrap();
        let error = read(&source(file.clone(), None, Some("t"), "s"), &names(&["tip_y"])).unwrap_err();
        assert!(error.code == 2 && error.message.contains(part), "{}", error.message);
    }
    let error = read(&source(folder.path().join("no.csv"), None, Some("t"), "s"), &[]).unwrap_err();
    assert!(error.message.contains("no.csv: cannot be read"), "{}", error.message);
}

#[test]
fn a_parquet_table_gives_the_rows_that_were_written() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("a.parquet");
    let columns = [
        ("t".to_owned(), Column::Integers(vec![0, 1000, 2000])),
        ("x".to_owned(), Column::Numbers(vec![Some(1.0), None, Some(3.0)])),
        ("name".to_owned(), Column::Texts(vec![None, None, None])),
    ];
    std::fs::write(&file, table("rows", &columns).unwrap()).unwrap();
    let rows = read(&source(file.clone(), None, Some("t"), "us"), &names(&["x"])).unwrap();
    assert_eq!(said(&rows), "[0.0, 0.001, 0.002] [[1.0, NaN, 3.0]]");
    let refused = |columns: &[&str]| {
        read(&source(file.clone(), None, Some("t"), "us"), &names(columns)).unwrap_err().message
    };
    assert!(refused(&["name"]).contains("column `name` holds no numbers"));
    assert!(refused(&["y"]).contains("no column `y`"));
    std::fs::write(&file, "no parquet").unwrap();
    assert!(refused(&["x"]).contains("not a readable Parquet file"));
}

/// A bag as recorders write it, by the `mcap` library: compressed chunks, several topics.
fn bag(file: &Path) {
    let mut bytes = std::io::Cursor::new(Vec::new());
    let options =
        ::mcap::WriteOptions::new().compression(Some(::mcap::Compression::Zstd)).chunk_size(Some(200));
    let mut writer = ::mcap::Writer::with_options(&mut bytes, options).unwrap();
    let point = writer.add_schema("geometry_msgs/msg/Point", "ros2msg", b"float64 x\nfloat64 y\nfloat64 z\n");
    let channel = writer.add_channel(point.unwrap(), "/tip", "cdr", &Default::default()).unwrap();
    let text = writer.add_schema("std_msgs/msg/String", "jsonschema", b"{}").unwrap();
    let other = writer.add_channel(text, "/text", "json", &Default::default()).unwrap();
    for i in 0..20_u64 {
        let mut data = vec![0, 1, 0, 0];
        [i as f64, 0.5, -1.0].iter().for_each(|x: &f64| data.extend(x.to_le_bytes()));
        let time = 1_000_000_000 + i * 1_000_000;
        let header = |channel_id| ::mcap::records::MessageHeader {
            channel_id,
            sequence: i as u32,
            log_time: time,
            publish_time: time - 500_000,
        };
        writer.write_to_known_channel(&header(channel), &data).unwrap();
        writer.write_to_known_channel(&header(other), b"{}").unwrap();
    }
    writer.finish().unwrap();
    drop(writer);
    std::fs::write(file, bytes.into_inner()).unwrap();
}

#[test]
fn topics_of_a_bag_are_read_by_field_with_either_time() {
    let folder = tempfile::tempdir().unwrap();
    bag(&folder.path().join("bag_0.mcap"));
    // The file itself, or the folder of a rosbag2.
    for path in [folder.path().join("bag_0.mcap"), folder.path().to_owned()] {
        let rows = read(&source(path.clone(), Some("/tip"), None, "s"), &names(&["z", "x"])).unwrap();
        assert_eq!((rows.times_s.len(), rows.columns[0][7], rows.columns[1][7]), (20, -1.0, 7.0));
        assert!((rows.times_s[7] - 1.007).abs() < 1e-12);
        let rows = read(&source(path, Some("/tip"), Some("publish_time"), "s"), &names(&["x"])).unwrap();
        assert!((rows.times_s[7] - 1.0065).abs() < 1e-12);
    }
    let refused = |topic: &str, column: &str| {
        let source = source(folder.path().to_owned(), Some(topic), None, "s");
        read(&source, &names(&[column])).unwrap_err().message
    };
    assert!(refused("/tp", "x").contains("no topic `/tp` (did you mean `/tip`?); it has /text, /tip"));
    assert!(refused("/tip", "w").contains("no column `w`"));
    assert!(refused("/text", "x").contains("messages in `json` with a schema in `jsonschema`"));
    let whole = std::fs::read(folder.path().join("bag_0.mcap")).unwrap();
    std::fs::write(folder.path().join("bag_0.mcap"), &whole[..whole.len() / 2]).unwrap();
    assert!(refused("/tip", "x").contains("damaged or not an MCAP file"));
    std::fs::remove_file(folder.path().join("bag_0.mcap")).unwrap();
    std::fs::write(folder.path().join("bag_0.db3"), "").unwrap();
    assert!(refused("/tip", "x").contains("`ros2 bag convert`"));
    for (name, advice) in [("bag_0.db3", "`ros2 bag convert`"), ("old.bag", "a bag of ROS 1")] {
        let source = source(folder.path().join(name), Some("/tip"), None, "s");
        let error = read(&source, &names(&["x"])).unwrap_err();
        assert!(error.code == 2 && error.message.contains(advice), "{}", error.message);
    }
}
