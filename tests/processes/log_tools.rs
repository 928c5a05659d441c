//! `trabecula log …` and the recording options, on logs of real runs.

use std::fs;
use std::path::Path;

use parquet::file::reader::{FileReader, SerializedFileReader};
use recorder_proc::log_file::LogFile;
use run_log::{ReadOptions, frames};
use rustix::process::Signal;

use crate::common::logs::{assert_replays, counts, recorded};
use crate::common::program::{Place, Run, signal, succeed, trabecula, wait_for};
use crate::common::scenes;

#[test]
fn images_are_recorded_as_asked_and_states_cost_the_same() {
    let place = Place::new();
    let scene = place.scene(&scenes::drill("lockstep", 0.5));
    let options: [&[&str]; 4] =
        [&[], &["--image-every", "2"], &["--images", "hash-only"], &["--images", "none"]];
    let mut images = Vec::new();
    let mut states = Vec::new();
    for (index, more) in options.iter().enumerate() {
        let ended = Run::start(&scene, place.path(&format!("out{index}")), more).end_well();
        assert_replays(&ended.folder);
        let count = counts(&ended.folder.join("run.mcap"));
        images.push((count["/drr/frame"], count["/drr/image"]));
        let done = trabecula(&[&"log", &"cat", &ended.folder, &"--topic", &"/state"]);
        states.push(done.out);
        let hashes: Vec<[u64; 2]> =
            frames(&LogFile::at(ended.folder.join("run.mcap")), ReadOptions::default())
                .unwrap()
                .map(|frame| frame.unwrap().frame.pixel_hash)
                .collect();
        assert!(hashes.iter().all(|hash| *hash != [0, 0]));
    }
    let all = images[0].0;
    assert!(all >= 5, "{images:?}");
    assert_eq!(images, [(all, all), (all, all.div_ceil(2)), (all, 0), (0, 0)]);
    assert!(states.iter().all(|text| *text == states[0]) && states[0].lines().count() == 501);

    let done = trabecula(&[&"run", &scene, &"--images", &"none", &"--image-every", &"3", &"--quiet"]);
    assert_eq!(done.code, Some(2));
    assert!(done.err.contains("--image-every is 3"), "{}", done.err);
}

#[test]
fn logs_are_packed_joined_split_and_exported() {
    let place = Place::new();
    let folder = place.complete(&scenes::drill("lockstep", 0.4)).folder;
    let path = |name: &str| place.path(name);
    let run = |arguments: &[&dyn AsRef<std::ffi::OsStr>]| {
        let done = succeed(arguments);
        done.out
    };
    let packed = path("packed.mcap");
    let said = run(&[&"log", &"compress", &folder, &"-o", &packed, &"--method", &"zstd", &"--level", &"3"]);
    assert!(said.contains("messages unchanged"), "{said}");
    assert_replays(&packed);
    assert!(run(&[&"log", &"diff", &folder, &packed]).contains("identical"));

    run(&[&"log", &"cat-files", &folder, &packed, &"-o", &path("both.mcap")]);
    run(&[&"log", &"split", &path("both.mcap"), &"-o", &path("runs")]);
    assert_replays(&path("runs/run2.mcap"));
    assert_eq!(fs::read(path("runs/run1.mcap")).unwrap(), fs::read(folder.join("run.mcap")).unwrap());
    let done = trabecula(&[&"log", &"info", &path("both.mcap")]);
    assert!(done.code == Some(2) && done.err.contains("contains 2 runs"), "{}", done.err);
    let done = trabecula(&[&"log", &"split", &folder, &"-o", &path("runs of one")]);
    assert!(done.code == Some(2) && done.err.contains("contains a single run; expected"), "{}", done.err);
    assert!(!path("runs of one").exists());

    let field: [&str; 2] = ["--field", "t_world_tip.position_m"];
    let said = run(&[&"log", &"export", &folder, &"-o", &path("tip.csv"), &field[0], &field[1]]);
    assert!(said.contains("401 rows and 5 columns of /state"), "{said}");
    // A range beyond the log's end is distinguished from one within it.
    let said = run(&[&"log", &"export", &folder, &"-o", &path("none.csv"), &"--from", &"401"]);
    assert!(said.contains(": 0 rows"), "{said}");
    assert_eq!(fs::read_to_string(path("tip.csv")).unwrap().lines().count(), 402);
    run(&[&"log", &"export", &folder, &"-o", &path("tip.parquet"), &field[0], &field[1]]);
    assert_eq!(parquet_rows(&path("tip.parquet")), 401);
    run(&[&"log", &"export", &folder, &"-o", &path("pictures"), &"--frames"]);
    let recorded: Vec<_> = frames(&LogFile::at(folder.join("run.mcap")), ReadOptions::default())
        .unwrap()
        .map(Result::unwrap)
        .collect();
    let mut names: Vec<_> = fs::read_dir(path("pictures")).unwrap().map(|e| e.unwrap().path()).collect();
    names.sort();
    assert_eq!(names.len(), recorded.len());
    for (name, frame) in names.iter().zip(&recorded) {
        let decoder = png::Decoder::new(std::io::BufReader::new(fs::File::open(name).unwrap()));
        let mut reader = decoder.read_info().unwrap();
        let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut pixels).unwrap();
        let wanted = frame.pixels.chunks_exact(2).map(|p| u16::from_le_bytes([p[0], p[1]]));
        assert!(pixels.chunks_exact(2).map(|p| u16::from_be_bytes([p[0], p[1]])).eq(wanted));
    }

    let lines =
        run(&[&"log", &"cat", &folder, &"--topic", &"/state", &"--from-s", &"0.1", &"--to-s", &"0.105"]);
    assert_eq!(lines.lines().count(), 6);
    // Regression: a range beyond the end printed nothing, as if the run had no states.
    let beyond = trabecula(&[&"log", &"cat", &folder, &"--topic", &"/state", &"--from", &"90000"]);
    assert_eq!((beyond.code, beyond.out.as_str()), (Some(0), ""));
    assert!(
        beyond.err.contains("no messages in this range; the last message on these topics is at tick"),
        "{}",
        beyond.err
    );
    let of_others = trabecula(&[&"log", &"cat", &folder, &"--topic", &"/state", &"--field", &"sequence"]);
    assert_eq!((of_others.out.as_str(), of_others.err.as_str()), ("", ""));
    for bad in [
        &["cat", "--from-s", "-1"][..],
        &["export", "-o", "x.xls"],
        &["compress", "-o", "y", "--level", "40"],
    ] {
        let mut arguments: Vec<&dyn AsRef<std::ffi::OsStr>> = vec![&"log", &bad[0], &folder];
        bad[1..].iter().for_each(|word| arguments.push(word));
        assert_eq!(trabecula(&arguments).code, Some(2), "{bad:?}");
    }
}

fn parquet_rows(file: &Path) -> i64 {
    let reader = SerializedFileReader::new(fs::File::open(file).unwrap()).unwrap();
    let rows = reader.metadata().file_metadata().num_rows();
    assert_eq!(reader.get_row_iter(None).unwrap().map(Result::unwrap).count() as i64, rows);
    rows
}

/// Regression: in Parquet the upper half of all hashes were negative numbers.
#[test]
fn hashes_are_the_same_in_both_tables_and_the_latest_run_is_found() {
    let place = Place::new();
    let folder = recorded(&place, &scenes::hold("lockstep", 0.05));
    let [csv, parquet] = ["x.csv", "x.parquet"].map(|name| place.path(name));
    let latest = folder.parent().unwrap().join("latest");
    for table in [&csv, &parquet] {
        let done = trabecula(&[&"log", &"export", &latest, &"-o", table, &"--field", &"hash"]);
        assert_eq!(done.code, Some(0), "{}", done.err);
    }
    let reader = SerializedFileReader::new(fs::File::open(parquet).unwrap()).unwrap();
    let rows = reader.get_row_iter(None).unwrap().map(|row| {
        let cells = row.unwrap().into_columns().into_iter().map(|(_, cell)| cell.to_string());
        cells.collect::<Vec<_>>().join(",")
    });
    let text = fs::read_to_string(csv).unwrap();
    assert!(rows.eq(text.lines().skip(1).map(str::to_owned)), "{text}");
    let upper =
        |line: &str| line.split(',').skip(2).any(|cell| cell.parse::<u64>().unwrap() > i64::MAX as u64);
    assert!(text.lines().skip(1).any(upper), "no hash is in the upper half");
}

#[test]
fn the_table_of_a_damaged_log_can_be_read() {
    let place = Place::new();
    let folder = recorded(&place, &scenes::hold("lockstep", 0.5));
    let mut bytes = fs::read(folder.join("run.mcap")).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    fs::write(folder.join("run.mcap"), &bytes).unwrap();
    let [csv, parquet] = ["x.csv", "x.parquet"].map(|name| place.path(name));
    for table in [&csv, &parquet] {
        let done = trabecula(&[&"log", &"export", &folder, &"-o", table]);
        assert!(done.code == Some(1) && done.err.contains("damaged at byte"), "{}", done.err);
    }
    let rows = fs::read_to_string(csv).unwrap().lines().count() as i64 - 1;
    assert!(rows > 50 && rows < 501 && parquet_rows(&parquet) == rows, "{rows}");
}

#[test]
fn the_drilled_ct_is_written_while_the_run_goes_on() {
    let place = Place::new();
    let scene = place.scene(&scenes::drill("realtime", 600.0));
    let run = Run::start(&scene, place.path("out"), &[]);
    let file = place.path("drilled.nrrd");
    let gone_in = || volume_io::read(&file).unwrap().hu.iter().filter(|hu| **hu == -1000).count();
    let drilled = |more: &[&dyn AsRef<std::ffi::OsStr>], folder: &Path| {
        let mut words: Vec<&dyn AsRef<std::ffi::OsStr>> = vec![&"volume", &"drilled", &folder, &"-o", &file];
        words.extend(more);
        trabecula(&words)
    };
    let early = wait_for("a log with drilled voxels", || {
        let folder = fs::read_dir(place.path("out")).ok()?.flatten().next()?.path();
        let _ = fs::remove_file(&file);
        let done = drilled(&[&"--tick", &"0"], &folder);
        let untouched = (done.code == Some(0)).then(gone_in)?;
        fs::remove_file(&file).unwrap();
        // The log has no end yet.
        let done = drilled(&[], &folder);
        (done.code == Some(3) && gone_in() > untouched).then(gone_in)
    });
    assert!(trabecula(&[&"volume", &"info", &file]).code == Some(0));
    signal(run.pid(), Signal::INT);
    let ended = run.end();
    assert_eq!(ended.code, Some(130), "{}", ended.err);
    // No file is overwritten.
    let before = fs::read(&file).unwrap();
    let done = drilled(&[], &ended.folder);
    assert!(done.code == Some(2) && done.err.contains("drilled.nrrd: already exists"), "{}", done.err);
    assert!(fs::read(&file).unwrap() == before);
    fs::remove_file(&file).unwrap();
    let done = drilled(&[], &ended.folder);
    assert_eq!(done.code, Some(0), "{}", done.err);
    assert!(gone_in() >= early);
    fs::remove_file(&file).unwrap();
    let done = drilled(&[&"--tick", &"999999999"], &ended.folder);
    assert!(done.code == Some(2) && done.err.contains("is past the end of the log at tick"), "{}", done.err);
}
