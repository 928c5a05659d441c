//! Small valid inputs, created by the writers of the project and its tests.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use ipc_types::messages::{Keyframe, Tick, TickTiming};
use ipc_types::scene::{Policy, Scene, Wait};
use ipc_types::session::Announcement;
use run_log::{EndReason, RunLog, TimingLog, Topic};
use volume_io::write_nrrd;
use voxel_grid::{Volume, VoxelGrid};
use zerocopy::IntoBytes;

#[path = "../../crates/volume_io/tests/common/dicom_bytes.rs"]
#[allow(missing_docs, dead_code)]
mod dicom_bytes;
#[path = "../../crates/run_log/tests/common/mod.rs"]
mod log_bytes;
#[path = "../../crates/volume_io/tests/common/nifti_bytes.rs"]
#[allow(missing_docs, dead_code)]
mod nifti_bytes;

use dicom_bytes::jpeg_2000;
pub(crate) use dicom_bytes::{DicomSlice, LOSSLESS_JPEG};
pub(crate) use log_bytes::Toy;
use log_bytes::{Step, feed, header, run_messages, write_log};
use nifti_bytes::NiftiBytes;

/// Transfer syntaxes of JPEG: baseline, extended, lossless twice.
pub(crate) const JPEG_SYNTAXES: [&str; 4] =
    ["1.2.840.10008.1.2.4.50", "1.2.840.10008.1.2.4.51", "1.2.840.10008.1.2.4.57", "1.2.840.10008.1.2.4.70"];
/// Transfer syntaxes of JPEG-LS and JPEG 2000, lossless.
pub(crate) const LATER_SYNTAXES: [&str; 2] = ["1.2.840.10008.1.2.4.80", "1.2.840.10008.1.2.4.90"];
/// Transfer syntax of a deflated data set.
pub(crate) const DEFLATED_SYNTAX: &str = "1.2.840.10008.1.2.1.99";
/// Transfer syntax of RLE lossless.
pub(crate) const RLE_SYNTAX: &str = "1.2.840.10008.1.2.5";

/// Bytes of a keyframe in one message.
const PART: usize = 4000;

/// A log of some ticks with keyframes.
fn log_with_keyframes(ticks: u64, interval: u64) -> Vec<u8> {
    let mut log = RunLog::create(Vec::new(), &header()).unwrap();
    let mut sequence = 0;
    for step in run_messages(ticks, None) {
        feed(&mut log, std::slice::from_ref(&step)).unwrap();
        let Step::State(state) = &step else { continue };
        if state.tick == 0 || state.tick % interval != 0 {
            continue;
        }
        let bytes = state.as_bytes();
        for (index, part) in bytes.chunks(PART).enumerate() {
            sequence += 1;
            let head = Keyframe {
                tick: state.tick,
                hash: state.hash,
                sequence,
                total_bytes: bytes.len() as u32,
                offset_bytes: (index * PART) as u32,
                reserved: 0,
                data_length: part.len() as u32,
            };
            log.keyframe(&[head.as_bytes(), part].concat()).unwrap();
        }
    }
    log.finish(EndReason::Completed, &BTreeMap::new()).unwrap().1
}

/// A timing lane with late ticks.
fn timing_log() -> Vec<u8> {
    let mut log = TimingLog::create(Vec::new(), &header()).unwrap();
    for tick in 0..5_u64 {
        let late = i64::from(tick == 3) * 2_500_000;
        let timing = TickTiming {
            tick,
            start_ns: tick * 1_000_000,
            wake_lateness_ns: late,
            missed: u32::from(late > 0),
            run_queue_wait_ns: late as u64,
            ..TickTiming::zeroed()
        };
        log.message(Topic::TickTiming, Tick(tick), timing.as_bytes()).unwrap();
    }
    log.finish(EndReason::Interrupted, &BTreeMap::from([("/state".to_owned(), 3)])).unwrap().1
}

/// Seeds: complete logs: short ones, one with a reset, one with keyframes, one of the timing lane.
pub fn logs() -> Vec<Vec<u8>> {
    let mut all: Vec<Vec<u8>> = [(1, None), (3, None), (25, Some(12))]
        .map(|(ticks, reset)| write_log(&run_messages(ticks, reset)))
        .to_vec();
    all.push(log_with_keyframes(6, 2));
    all.push(timing_log());
    all
}

/// Seeds: the unpacked records of the chunks of a log, all together and chunk by chunk.
pub fn chunks() -> Vec<Vec<u8>> {
    let unpacked = |bytes: &[u8]| -> Vec<Vec<u8>> {
        let summary = mcap::Summary::read(bytes).unwrap().unwrap();
        let unpack = |index: &mcap::records::ChunkIndex| {
            let start = index.chunk_start_offset as usize + 9;
            let record =
                mcap::parse_record(6, &bytes[start..start + index.chunk_length as usize - 9]).unwrap();
            let mcap::records::Record::Chunk { header, data } = record else { panic!("a chunk") };
            let mut out = Vec::with_capacity(header.uncompressed_size as usize);
            std::io::Read::read_to_end(&mut lz4::Decoder::new(&data[..]).unwrap(), &mut out).unwrap();
            out
        };
        summary.chunk_indexes.iter().map(unpack).collect()
    };
    let mut all = Vec::new();
    for log in
        [write_log(&run_messages(2, None)), write_log(&run_messages(9, Some(4))), log_with_keyframes(4, 2)]
    {
        let pieces = unpacked(&log);
        all.push(pieces.concat());
        all.push(pieces[0].clone());
    }
    all
}

/// Returns a folder of the repository.
fn folder(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(name)
}

fn files(name: &str) -> Vec<Vec<u8>> {
    let mut paths: Vec<PathBuf> = std::fs::read_dir(folder(name))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.is_file())
        .collect();
    paths.sort();
    paths.iter().map(|path| std::fs::read(path).unwrap()).collect()
}

/// Loads one of the scenes of `configs/`.
pub(crate) fn scene_file(name: &str) -> Scene {
    ipc_types::scene_file::load(&folder("configs").join(name)).unwrap()
}

/// Seeds: the scenes of `configs/`.
pub fn scenes() -> Vec<Vec<u8>> {
    files("configs")
}

/// Seeds: a calibration and an announcement.
pub fn settings() -> Vec<Vec<u8>> {
    let announcement = Announcement {
        pid: 4711,
        iceoryx2: "0.10.0".to_owned(),
        trabecula: "0.1.0".to_owned(),
        layouts: BTreeMap::from([("state".to_owned(), "0123".to_owned())]),
        controllers: vec!["a".to_owned()],
        volume_bytes: 4096,
        frame_bytes: 0,
        recorder: true,
        wait: Wait::Hybrid,
        policy: Policy::Other,
    };
    let whole = String::from_utf8(files("configs/calibration").remove(0)).unwrap();
    let rows: Vec<&str> = whole.lines().take(4).collect();
    vec![rows.join("\n").into_bytes(), whole.into_bytes(), serde_json::to_vec_pretty(&announcement).unwrap()]
}

/// Seeds: NIfTI-1, plain and compressed, and a detached header.
pub fn nifti() -> Vec<Vec<u8>> {
    let affine = [[1.0, 0.0, 0.0, 5.0], [0.0, 2.0, 0.0, 6.0], [0.0, 0.0, 3.0, 7.0]];
    let plain = NiftiBytes::new([2, 3, 4], affine, &[7; 24]);
    let mut float = NiftiBytes::new([2, 3, 4], affine, &[0x3f80; 48]);
    float.put(70, &16_i16.to_le_bytes());
    float.put(72, &32_i16.to_le_bytes());
    // With a quaternion.
    let mut turned = NiftiBytes::new([2, 3, 4], affine, &[7; 24]);
    turned.put(252, &1_i16.to_le_bytes());
    turned.put(254, &0_i16.to_le_bytes());
    let mut pair = NiftiBytes::new([2, 3, 4], affine, &[]);
    pair.put(344, b"ni1\0");
    let mut gz = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::best());
    std::io::Write::write_all(&mut gz, &plain.0).unwrap();
    vec![gz.finish().unwrap(), plain.0, float.0, turned.0, pair.0]
}

/// Seeds: NRRD: raw, compressed, as text, and a detached header.
pub fn nrrd() -> Vec<Vec<u8>> {
    let grid = VoxelGrid::axis_aligned([2, 3, 4], [1e-3; 3], [0.0; 3]).unwrap();
    let volume = Volume { grid, hu: (0..24).collect() };
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("v.nrrd");
    write_nrrd(&path, &volume).unwrap();
    let header = |encoding: &str, more: &str| {
        format!(
            "NRRD0005\n# a comment\ntype: short\ndimension: 3\nspace: right-anterior-superior\nsizes: 2 3 4\n\
             space directions: (1,0,0) (0,1,0) (0,0,2)\nkinds: domain domain domain\nendian: big\n\
             space units: \"mm\" \"mm\" \"mm\"\nencoding: {encoding}\nspace origin: (1,2,3)\n{more}\n"
        )
    };
    let text: Vec<String> = (0..24).map(|voxel| voxel.to_string()).collect();
    let with = |header: String, data: &[u8]| [header.as_bytes(), data].concat();
    vec![
        std::fs::read(path).unwrap(),
        with(header("raw", "byte skip: -1\n"), &[3; 60]),
        with(header("gzip", ""), &[3; 48]),
        with(header("bzip2", "line skip: 0\n"), &[3; 48]),
        with(header("ascii", ""), text.join(" ").as_bytes()),
        with(header("raw", "data file: v.raw\nline skip: 1\nbyte skip: 2\n"), &[]),
        with(
            header("raw", "").replace("space directions", "#").replace("space origin", "spacings: 1 1 2\n#"),
            &[3; 48],
        ),
    ]
}

/// Seeds: MetaImage: local, compressed, as text, and with a data file.
pub fn metaimage() -> Vec<Vec<u8>> {
    let header = |binary: &str, packed: &str, kind: &str, file: &str| {
        format!(
            "ObjectType = Image\nNDims = 3\nBinaryData = {binary}\nBinaryDataByteOrderMSB = False\n\
             CompressedData = {packed}\nTransformMatrix = 1 0 0 0 1 0 0 0 1\nOffset = 1 2 3\n\
             CenterOfRotation = 0 0 0\nAnatomicalOrientation = RAI\nElementSpacing = 1 1 1\nDimSize = 2 3 4\n\
             ElementType = {kind}\nElementDataFile = {file}\n"
        )
    };
    let with = |header: String, data: &[u8]| [header.as_bytes(), data].concat();
    let text: Vec<String> = (0..24).map(|voxel| voxel.to_string()).collect();
    vec![
        with(header("True", "False", "MET_SHORT", "LOCAL"), &[1; 48]),
        with(header("True", "True", "MET_UCHAR", "LOCAL"), &[1; 24]),
        with(header("True", "False", "MET_FLOAT", "v.raw"), &[]),
        with(header("False", "False", "MET_INT", "LOCAL"), text.join(" ").as_bytes()),
        with(
            header("True", "False", "MET_SHORT", "LOCAL").replace("DimSize", "HeaderSize = -1\nDimSize"),
            &[1; 48],
        ),
    ]
}

/// Seeds: DICOM: slices in several encodings, and compressed pixels alone.
pub fn dicom() -> Vec<Vec<u8>> {
    let mut rle = vec![0_u8; 64];
    (rle[0], rle[4], rle[8]) = (2, 64, 66);
    rle.extend([(257_u16 - 20) as u8, 4, 19]);
    rle.extend(0..=20_u8);
    let jpeg = LOSSLESS_JPEG.to_vec();
    let slice = |syntax, fragment| DicomSlice { transfer_syntax: syntax, fragment, ..DicomSlice::default() };
    vec![
        slice("1.2.840.10008.1.2.1", None).bytes(),
        slice(RLE_SYNTAX, Some(rle.clone())).bytes(),
        slice(JPEG_SYNTAXES[3], Some(jpeg.clone())).bytes(),
        [&[4, 4, 5], rle.as_slice()].concat(),
        [&[5, 4, 5], jpeg_ls().as_slice()].concat(),
        // Without preamble and file meta group.
        slice("1.2.840.10008.1.2.1", None).bytes()[132..].to_vec(),
        [&[3, 4, 5], jpeg.as_slice()].concat(),
        [&[0, 4, 5], jpeg.as_slice()].concat(),
        slice(LATER_SYNTAXES[1], Some(jpeg_2000(4, 5))).bytes(),
        [&[6, 4, 5], jpeg_2000(4, 5).as_slice()].concat(),
        [&[6, 100, 130], jpeg_2000_tiles().as_slice()].concat(),
    ]
}

/// Builds a JPEG 2000 codestream of 130 x 100 pixels (ITU-T T.800) with features that [`jpeg_2000`] lacks:
/// four tiles, two decompositions by the irreversible transform, three layers, precincts, code-blocks of 16 x
/// 16 in segments of several passes, and packets of arbitrary bits.
fn jpeg_2000_tiles() -> Vec<u8> {
    let whole = jpeg_2000(100, 130);
    let [siz, main] = [whole[..45].to_vec(), whole[45..].to_vec()];
    let mut data = siz;
    data[24..28].copy_from_slice(&65_u32.to_be_bytes());
    data[28..32].copy_from_slice(&50_u32.to_be_bytes());
    // By position, markers of packets, three layers; blocks of 16 x 16, terminated and bypassing the
    // arithmetic coder.
    data.extend([0xff, 0x52, 0, 15, 7, 2, 0, 3, 0, 2, 2, 2, 0x2d, 0, 0x44, 0x55, 0x66]);
    // Two guard bits, the exponents and mantissas of 7 subbands.
    data.extend([0xff, 0x5c, 0, 17, 0x42]);
    data.extend((0..7_u16).flat_map(|band| (((16 - band) << 11) | (100 * band)).to_be_bytes()));
    let sot = &main[20..34];
    for tile in 0..4_u8 {
        let packets: Vec<u8> = (0..200_u32).map(|n| ((n * 97 + u32::from(tile) * 31) >> 2) as u8).collect();
        let mut part = sot.to_vec();
        part[5] = tile;
        part[6..10].copy_from_slice(&(14 + packets.len() as u32).to_be_bytes());
        data.extend([part, packets].concat());
    }
    data.extend([0xff, 0xd9]);
    data
}

/// Builds a JPEG-LS frame of 5 x 4 pixels (ITU-T T.87): headers, and a scan of arbitrary bits.
fn jpeg_ls() -> Vec<u8> {
    let mut data = vec![0xff, 0xd8, 0xff, 0xf7, 0, 11, 12, 0, 4, 0, 5, 1, 1, 0x11, 0];
    // Presets: MAXVAL, T1, T2, T3, RESET.
    data.extend([0xff, 0xf8, 0, 13, 1, 0x0f, 0xff, 0, 18, 0, 67, 1, 0x14, 0, 64]);
    data.extend([0xff, 0xda, 0, 8, 1, 1, 0, 0, 0, 0]);
    data.extend((0..60_u8).map(|n| n.wrapping_mul(37) & 0x7f));
    data.extend([0xff, 0xd9]);
    data
}
