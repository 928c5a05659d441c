//! `trabecula calibrate`: a sweep, from the command line to the files.

use std::fs;

use controllers::Calibration;

use crate::common::program::{Place, succeed};
use crate::common::scenes;

const SWEEP: &str = "tension_sweep = { most_n = 4.0, step_n = 1.0, settle_s = 0.1 }";

#[test]
fn a_sweep_is_written_as_a_table_that_controllers_read_and_as_a_picture() {
    let place = Place::new();
    let scene = place.scene(&scenes::hold("lockstep", 60.0).replace("hold = { tension_n = 2.0 }", SWEEP));
    let folder = place.path("made/anew");
    let done = succeed(&[&"calibrate", &scene, &"-o", &folder]);
    // Up in steps of 1 N to 4 N, and down again.
    let calibration =
        Calibration::load(&folder.join("calibration.csv"), &ipc_types::text_file::read).unwrap();
    let levels: Vec<(bool, f64)> = calibration.rows.iter().map(|row| (row.rising, row.commanded)).collect();
    let up = [0.0, 1.0, 2.0, 3.0, 4.0].map(|tension_n| (true, tension_n));
    let down = [3.0, 2.0, 1.0, 0.0].map(|tension_n| (false, tension_n));
    assert_eq!(levels, [up.as_slice(), &down].concat());
    let rising = || calibration.rows.iter().filter(|row| row.rising);
    assert!(rising().zip(rising().skip(1)).all(|(a, b)| a.bend_deg < b.bend_deg), "{calibration:?}");
    let inverse = calibration.tension_for_bend_n(calibration.rows[2].bend_deg).unwrap();
    assert!((inverse - 2.0).abs() < 1e-3, "six decimals in the file: {inverse}");
    assert!(done.out.contains("levels       9") && done.out.contains("calibration.svg"), "{}", done.out);

    let png =
        png::Decoder::new(std::io::BufReader::new(fs::File::open(folder.join("calibration.png")).unwrap()));
    let mut png = png.read_info().unwrap();
    let mut pixels = vec![0; png.output_buffer_size().unwrap()];
    png.next_frame(&mut pixels).unwrap();
    let first = pixels[0];
    assert!(pixels.iter().any(|pixel| *pixel != first), "an empty picture");
    let svg = fs::read_to_string(folder.join("calibration.svg")).unwrap();
    assert!(svg.starts_with("<svg") && svg.contains("calibration of tendon 0, 9 levels"), "{svg:.300}");
    // Both directions: at least one mark or line per level.
    assert!(svg.matches("<circle").count() + svg.matches("<polyline").count() >= 2, "{svg:.300}");
}
