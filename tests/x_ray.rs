//! `trabecula drr`: files of X-ray frames, and rejected input.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use test_support::debian::program_or_skip;
use test_support::limited::Limited;
use test_support::python;

use dicom_object::{Tag, open_file};

struct Done {
    code: Option<i32>,
    err: String,
}

fn trabecula(arguments: &[&str]) -> Done {
    let output = Command::new(env!("CARGO_BIN_EXE_trabecula")).args(arguments).limited_output().unwrap();
    Done { code: output.status.code(), err: String::from_utf8_lossy(&output.stderr).into_owned() }
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// Returns a folder with a ball of 1 mm voxels, and the options of a small detector.
fn ball() -> (tempfile::TempDir, PathBuf) {
    let place = tempfile::tempdir().unwrap();
    let volume = place.path().join("ball.nrrd");
    assert_eq!(trabecula(&["phantom", "sphere", "-o", text(&volume), "--spacing-mm", "1"]).code, Some(0));
    (place, volume)
}

const SMALL: [[&str; 2]; 3] = [["--columns", "64"], ["--rows", "48"], ["--pixel-pitch-mm", "3"]];

/// Renders a small frame, except for the settings in `more`.
fn drr(volume: &Path, output: &Path, more: &[&str]) -> Done {
    let small = SMALL.iter().filter(|[flag, _]| !more.contains(flag)).flatten().copied();
    let head = ["drr", text(volume), "-o", text(output)];
    trabecula(&head.into_iter().chain(small).chain(more.iter().copied()).collect::<Vec<_>>())
}

fn png(path: &Path) -> (png::OutputInfo, Vec<u8>, Option<u32>) {
    let decoder = png::Decoder::new(std::io::BufReader::new(fs::File::open(path).unwrap()));
    let mut reader = decoder.read_info().unwrap();
    let frames = reader.info().animation_control.map(|a| a.num_frames);
    let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut bytes).unwrap();
    (info, bytes, frames)
}

#[test]
fn the_same_pose_by_angles_by_camera_and_by_points_is_the_same_picture() {
    let (place, volume) = ball();
    let path = |name: &str| place.path().join(name);
    // Source 700 mm behind the origin's posterior side, detector 300 mm in front of it: frontal.
    let common = "columns = 64\nrows = 48\npixel_pitch_mm = 3.0\n";
    let camera = "intrinsics = [[-333.3333333333333, 0.0, 31.5], [0.0, 333.3333333333333, 23.5], [0.0, 0.0, 1.0]]\n\
                  rotation = [[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]]\n\
                  translation_mm = [0.0, 0.0, 700.0]\n";
    let points = "source_mm = [0.0, 700.0, 0.0]\ndetector_centre_mm = [0.0, -300.0, 0.0]\n\
                  row_axis = [1.0, 0.0, 0.0]\ncolumn_axis = [0.0, 0.0, -1.0]\n";
    fs::write(path("camera.toml"), [camera, common].concat()).unwrap();
    fs::write(path("points.toml"), [points, common].concat()).unwrap();
    let json = r#"{"pose": [{"primary_angle_deg": 0, "isocentre_mm": [0, 0, 0]}]}"#;
    fs::write(path("angles.json"), json).unwrap();
    let mut pictures = Vec::new();
    for pose in ["camera.toml", "points.toml", "angles.json"] {
        let output = path(&format!("{pose}.png"));
        let done = drr(&volume, &output, &["--pose", text(&path(pose))]);
        assert_eq!(done.code, Some(0), "{}", done.err);
        let (info, bytes, _) = png(&output);
        assert_eq!((info.width, info.height, info.bit_depth), (64, 48, png::BitDepth::Sixteen));
        pictures.push(bytes.chunks(2).map(|b| u16::from_be_bytes([b[0], b[1]])).collect::<Vec<_>>());
    }
    assert!(pictures[0].iter().max() > pictures[0].iter().min());
    for other in &pictures[1..] {
        // The focal length of the camera is rounded in its last digit.
        assert!(pictures[0].iter().zip(other).all(|(a, b)| a.abs_diff(*b) <= 1));
    }
}

#[test]
fn a_dicom_file_says_how_it_was_taken_and_an_nrrd_file_holds_the_attenuation() {
    let (place, volume) = ball();
    let path = |name: &str| place.path().join(name);
    let pose = ["--primary-deg", "30", "--secondary-deg", "-20", "--source-detector-mm", "1100"];
    assert_eq!(drr(&volume, &path("f.dcm"), &pose).code, Some(0));
    assert_eq!(drr(&volume, &path("f.png"), &pose).code, Some(0));
    assert_eq!(
        drr(&volume, &path("f.nrrd"), &[&pose[..], &["--display", "bone-bright"]].concat()).code,
        Some(0)
    );
    assert_eq!(drr(&volume, &path("l.dcm"), &["--display", "linear"]).code, Some(0));
    for (file, relationship) in [("f.dcm", "LOG"), ("l.dcm", "LIN")] {
        let object = open_file(path(file)).unwrap();
        assert_eq!(object.element(Tag(0x0028, 0x1040)).unwrap().to_str().unwrap(), relationship);
    }
    let object = open_file(path("f.dcm")).unwrap();
    let number = |group, element| object.element(Tag(group, element)).unwrap().to_float64().unwrap();
    for (group, element, want) in [
        (0x0018, 0x1110, 1100.0),
        (0x0018, 0x1111, 700.0),
        (0x0018, 0x1510, 30.0),
        (0x0018, 0x1511, -20.0),
        (0x0028, 0x0010, 48.0),
        (0x0028, 0x0011, 64.0),
    ] {
        assert!((number(group, element) - want).abs() < 1e-5, "{group:x} {element:x}");
    }
    let spacing = object.element(Tag(0x0018, 0x1164)).unwrap().to_multi_float64().unwrap();
    assert_eq!(spacing, [3.0, 3.0]);
    let pixels = object.element(Tag(0x7fe0, 0x0010)).unwrap().to_multi_int::<u16>().unwrap();
    let greys: Vec<u16> = png(&path("f.png")).1.chunks(2).map(|b| u16::from_be_bytes([b[0], b[1]])).collect();
    assert_eq!(pixels, greys);
    let nrrd = fs::read(path("f.nrrd")).unwrap();
    let data = &nrrd[nrrd.len() - 64 * 48 * 4..];
    let values: Vec<f32> = data.chunks(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
    // Bone is dark: the larger the attenuation the smaller the grey value.
    for (pair, grey) in values.windows(2).zip(greys.windows(2)) {
        assert!(pair[0] <= pair[1] || grey[0] <= grey[1]);
    }
    assert!(values.iter().all(|v| (0.0..20.0).contains(v)) && values.iter().any(|v| *v > 0.5));
}

/// The files as read by radiologists' and engineers' software.
#[test]
fn pydicom_and_simpleitk_read_the_files() {
    let packages = ["pydicom==3.0.2", "SimpleITK==2.5.7"];
    let python = python::or_skip("pydicom-3.0.2-simpleitk-2.5.7", &packages, "pydicom, SimpleITK");
    let Some(python) = python else { return };
    let (place, volume) = ball();
    let path = |name: &str| place.path().join(name);
    let pose = ["--primary-deg", "30", "--secondary-deg", "-20"];
    for name in ["f.dcm", "f.png", "f.nrrd"] {
        assert_eq!(drr(&volume, &path(name), &pose).code, Some(0));
    }
    let script = "
import sys, pydicom, SimpleITK as sitk
d = pydicom.dcmread(sys.argv[1])
print(d.SOPClassUID.name, '|', d.Modality, d.Rows, d.Columns, d.BitsStored, float(d.PositionerPrimaryAngle), float(d.PositionerSecondaryAngle))
print(sum(int.from_bytes(d.PixelData[i:i + 2], 'little') for i in range(0, len(d.PixelData), 2)))
for name in sys.argv[1:]:
    image = sitk.ReadImage(name)
    statistics = sitk.StatisticsImageFilter()
    statistics.Execute(image)
    print(*image.GetSize()[:2], repr(statistics.GetSum()))
";
    let output = Command::new(&python)
        .args(["-c", script, text(&path("f.dcm")), text(&path("f.nrrd"))])
        .limited_output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let printed = String::from_utf8(output.stdout).unwrap();
    let lines: Vec<&str> = printed.lines().collect();
    let greys = png(&path("f.png")).1;
    let sum: u64 = greys.chunks(2).map(|b| u64::from(u16::from_be_bytes([b[0], b[1]]))).sum();
    assert_eq!(lines[0], "X-Ray Angiographic Image Storage | XA 48 64 16 30.0 -20.0");
    assert_eq!((lines[1], lines[2]), (sum.to_string().as_str(), format!("64 48 {sum}.0").as_str()));
    let nrrd = fs::read(path("f.nrrd")).unwrap();
    let data = &nrrd[nrrd.len() - 64 * 48 * 4..];
    let values = data.chunks(4).map(|b| f64::from(f32::from_le_bytes(b.try_into().unwrap())));
    let (size, theirs) = lines[3].rsplit_once(' ').unwrap();
    let (theirs, ours): (f64, f64) = (theirs.parse().unwrap(), values.sum());
    // The libraries sum in another order.
    assert!(size == "64 48" && (theirs / ours - 1.0).abs() < 1e-12, "{theirs} {ours}");
}

#[test]
fn a_sweep_is_a_numbered_series_or_an_animation_and_a_csv_file_is_a_batch() {
    let (place, volume) = ball();
    let path = |name: &str| place.path().join(name);
    assert_eq!(drr(&volume, &path("s.png"), &["--sweep", "180", "--frames", "3"]).code, Some(0));
    assert!((0..3).all(|i| path(&format!("s_{i:04}.png")).exists()) && !path("s.png").exists());
    let animated = drr(&volume, &path("a.png"), &["--sweep", "-90", "--frames", "4", "--animate"]);
    assert_eq!(animated.code, Some(0), "{}", animated.err);
    assert_eq!(png(&path("a.png")).2, Some(4));
    fs::write(path("batch.csv"), "\u{feff}primary_angle_deg, secondary_angle_deg\n0, 0\n90, 5\n").unwrap();
    assert_eq!(drr(&volume, &path("b.dcm"), &["--pose", text(&path("batch.csv"))]).code, Some(0));
    assert!(path("b_0000.dcm").exists() && path("b_0001.dcm").exists());
}

/// Regression: every frame was a separate study, of a patient with an incomplete record; angles of zero were
/// -0.
#[test]
fn a_sweep_is_one_series_that_dciodvfy_accepts() {
    let (place, volume) = ball();
    let path = |name: &str| place.path().join(name);
    assert_eq!(drr(&volume, &path("s.dcm"), &["--sweep", "-90", "--frames", "3"]).code, Some(0));
    let bright = ["--display", "bone-bright", "--tube-kv", "80"];
    assert_eq!(drr(&volume, &path("b.dcm"), &bright).code, Some(0));
    assert_eq!(drr(&volume, &path("l.dcm"), &["--display", "linear"]).code, Some(0));
    let sweep: Vec<PathBuf> = (0..3).map(|i| path(&format!("s_{i:04}.dcm"))).collect();
    let text_of = |file: &Path, group, element| {
        open_file(file).unwrap().element(Tag(group, element)).unwrap().to_str().unwrap().trim().to_owned()
    };
    for (group, element) in [(0x0020, 0x000d), (0x0020, 0x000e)] {
        let all: Vec<String> = sweep.iter().map(|file| text_of(file, group, element)).collect();
        assert!(all.iter().all(|uid| *uid == all[0]), "{all:?}");
    }
    let instances: Vec<String> = sweep.iter().map(|file| text_of(file, 0x0008, 0x0018)).collect();
    assert!(instances[0] != instances[1] && instances[1] != instances[2]);
    let numbers: Vec<String> = sweep.iter().map(|file| text_of(file, 0x0020, 0x0013)).collect();
    assert_eq!(numbers, ["1", "2", "3"]);
    for file in &sweep {
        let angles = [text_of(file, 0x0018, 0x1510), text_of(file, 0x0018, 0x1511)];
        assert!(angles.iter().all(|angle| !angle.starts_with("-0.0") && angle != "-0"), "{angles:?}");
    }
    assert_eq!(text_of(&sweep[0], 0x0020, 0x0020), "L\\F");
    assert_eq!(text_of(&path("b.dcm"), 0x0018, 0x0060), "80.00000000");
    // Greys to intensity: the brightest grey of a frame with dark bone is the full intensity.
    let object = open_file(&sweep[0]).unwrap();
    let table = object.element(Tag(0x0028, 0x3000)).unwrap().items().unwrap()[0].clone();
    let entries = table.element(Tag(0x0028, 0x3006)).unwrap().to_multi_int::<u16>().unwrap();
    assert!(
        entries.len() == 65536
            && entries[65535] == 65535
            && entries.windows(2).all(|pair| pair[0] <= pair[1])
    );

    let Some(dciodvfy) = program_or_skip("dicom3tools", "dciodvfy") else { return };
    for file in sweep.iter().chain(&[path("b.dcm"), path("l.dcm")]) {
        let output = Command::new(&dciodvfy).arg(file).limited_output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        println!("{}:\n{said}", file.display());
        assert!(said.contains("XAImage") && !said.contains("Error"), "{}: {said}", file.display());
    }
}
