//! Hostile and unusual files, each passed to the command that reads it: the verdict, the time and the peak
//! memory. Also the cost of the largest volumes in the smallest files.
//!
//! `WRITE_TABLE=1 cargo test --release --test processes -- hostile` writes `docs/hostile_files.md`.

use std::ffi::{OsStr, OsString};
use std::fs::{self, File};
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::LazyLock;
use std::time::Instant;

use crate::common::program::{Place, wait_for};
use crate::dicom_bytes::{DicomSlice, JPEG_2000_SYNTAXES, LOSSLESS_JPEG, jpeg_2000, write_series};

const PAGE: &str = "docs/hostile_files.md";
/// Limit on the address space of a rejection, KiB: the program, its threads' stacks, 16 MiB that compressed
/// data may grow by before the ratio counts, and the syntax tree of a large text.
const MOST_KIB: u64 = 512 << 10;

/// A file with a description of its fault, and the command that reads it.
struct Case {
    what: String,
    words: Vec<OsString>,
}

struct Cases {
    place: Place,
    all: Vec<Case>,
}

impl Cases {
    fn add(&mut self, what: &str, command: &str, path: &Path) {
        let mut words: Vec<OsString> = command.split(' ').map(OsString::from).collect();
        words.push(path.into());
        self.all.push(Case { what: what.to_owned(), words });
    }

    /// Returns a path in the case's own folder, so that several cases can use the same name.
    fn path(&self, name: &str) -> PathBuf {
        let folder = self.place.path(&format!("{}", self.all.len()));
        fs::create_dir_all(&folder).unwrap();
        folder.join(name)
    }

    fn file(&mut self, what: &str, command: &str, name: &str, content: &[u8]) {
        let path = self.path(name);
        fs::write(&path, content).unwrap();
        self.add(what, command, &path);
    }

    fn volume(&mut self, what: &str, name: &str, content: &[u8]) {
        self.file(what, "volume info", name, content);
    }
}

fn gzip(data: &[u8]) -> Vec<u8> {
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::best());
    encoder.write_all(data).unwrap();
    encoder.finish().unwrap()
}

/// A GiB of zeros as one gzip stream, compressed once.
fn bomb() -> &'static [u8] {
    static BOMB: LazyLock<Vec<u8>> = LazyLock::new(|| gzip_zeros(1 << 30));
    &BOMB
}

/// Zeros as one gzip stream.
fn gzip_zeros(bytes: usize) -> Vec<u8> {
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::best());
    let zeros = vec![0; 1 << 20];
    for start in (0..bytes).step_by(zeros.len()) {
        encoder.write_all(&zeros[..zeros.len().min(bytes - start)]).unwrap();
    }
    encoder.finish().unwrap()
}

/// A label map as one zlib stream: `slices` slices of 800 x 800 bytes, of which every hundredth has a square
/// of labels.
fn zlib_labels(slices: usize) -> Vec<u8> {
    let mut encoder = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::best());
    for slice in 0..slices {
        let mut labels = vec![0_u8; 800 * 800];
        if slice % 100 == 99 {
            labels.chunks_mut(800).skip(300).take(200).for_each(|row| row[300..500].fill(1));
        }
        encoder.write_all(&labels).unwrap();
    }
    encoder.finish().unwrap()
}

fn bzip2_bomb() -> Vec<u8> {
    let mut encoder = bzip2::write::BzEncoder::new(Vec::new(), bzip2::Compression::best());
    encoder.write_all(&vec![0; 30 << 20]).unwrap();
    encoder.finish().unwrap().repeat(35)
}

fn nrrd(lines: &str, data: &[u8]) -> Vec<u8> {
    [format!("NRRD0005\n{lines}\n").as_bytes(), data].concat()
}

/// Returns the usual lines of an NRRD header, with these sizes and encoding.
fn usual(sizes: &str, encoding: &str) -> String {
    format!(
        "type: short\ndimension: 3\nspace: left-posterior-superior\nsizes: {sizes}\nspace directions: (1,0,0) (0,1,0) (0,0,1)\n\
         space origin: (0,0,0)\nendian: little\nencoding: {encoding}\n"
    )
}

fn mhd(dimensions: &str, more: &str) -> Vec<u8> {
    format!(
        "ObjectType = Image\nNDims = 3\nDimSize = {dimensions}\nElementSpacing = 1 1 1\nElementType = MET_SHORT\n{more}\n"
    )
    .into_bytes()
}

/// Returns a NIfTI-1 file: a header of 348 bytes, int16, followed by data.
fn nifti(dims: [i16; 3], change: impl Fn(&mut [u8])) -> Vec<u8> {
    let mut header = vec![0; 352];
    header[0..4].copy_from_slice(&348_i32.to_le_bytes());
    for (place, dim) in [3, dims[0], dims[1], dims[2], 1, 1, 1, 1].into_iter().enumerate() {
        header[40 + 2 * place..42 + 2 * place].copy_from_slice(&dim.to_le_bytes());
    }
    header[70..72].copy_from_slice(&4_i16.to_le_bytes());
    header[72..74].copy_from_slice(&16_i16.to_le_bytes());
    for place in 0..4 {
        header[76 + 4 * place..80 + 4 * place].copy_from_slice(&1.0_f32.to_le_bytes());
    }
    header[108..112].copy_from_slice(&352.0_f32.to_le_bytes());
    header[254..256].copy_from_slice(&1_i16.to_le_bytes());
    for row in 0..3 {
        let place = 280 + 16 * row + 4 * row;
        header[place..place + 4].copy_from_slice(&1.0_f32.to_le_bytes());
    }
    header[344..348].copy_from_slice(b"n+1\0");
    change(&mut header);
    header
}

fn of_no_format(cases: &mut Cases) {
    let noise: Vec<u8> = (0..1_u32 << 16).map(|n| (n.wrapping_mul(0x9e37_79b1) >> 24) as u8).collect();
    let contents: [(&str, &[u8]); 4] = [
        ("empty", b""),
        ("a word", b"hello"),
        ("1 MiB of zeros", &[0; 1 << 20]),
        ("64 KiB of noise", &noise),
    ];
    for extension in ["nii", "nii.gz", "nrrd", "nhdr", "mha", "mhd", "dcm"] {
        for (what, content) in contents {
            cases.volume(&format!("{what}, named .{extension}"), &format!("v.{extension}"), content);
        }
    }
    let fifo = |path: &Path| {
        let mode = rustix::fs::Mode::RUSR | rustix::fs::Mode::WUSR;
        rustix::fs::mknodat(rustix::fs::CWD, path, rustix::fs::FileType::Fifo, mode, 0).unwrap();
    };
    for (command, name) in
        [("volume info", "v.nrrd"), ("scene check", "s.toml"), ("log info", "run.mcap"), ("run", "s.toml")]
    {
        let path = cases.path(name);
        fifo(&path);
        cases.add(&format!("a pipe for `{command}`"), command, &path);
        let path = cases.path(name);
        std::os::unix::fs::symlink("/dev/zero", &path).unwrap();
        cases.add(&format!("/dev/zero for `{command}`"), command, &path);
    }
}

/// 800³ voxels of two bytes in a megabyte.
fn largest() -> &'static [u8] {
    static LARGEST: LazyLock<Vec<u8>> =
        LazyLock::new(|| nrrd(&usual("800 800 800", "gzip"), &gzip_zeros(2 * 800 * 800 * 800)));
    &LARGEST
}

fn nrrd_files(cases: &mut Cases) {
    let mut add = |what: &str, content: &[u8]| cases.volume(&format!("NRRD: {what}"), "v.nrrd", content);
    add("2^40 samples", &nrrd(&usual("1048576 1024 1024", "raw"), b""));
    add("2^29 samples, no data", &nrrd(&usual("1024 1024 512", "raw"), b""));
    add("sizes whose product overflows", &nrrd(&usual("4294967296 4294967296 4294967296", "raw"), b""));
    add("negative sizes", &nrrd(&usual("-4 4 4", "raw"), &[0; 128]));
    add("no voxel", &nrrd(&usual("0 4 4", "raw"), &[0; 128]));
    add("axes that are no numbers", &nrrd(&usual("4 4 4", "raw").replace("(1,0,0)", "(nan,0,0)"), &[0; 128]));
    add("endless axes", &nrrd(&usual("4 4 4", "raw").replace("(1,0,0)", "(inf,0,0)"), &[0; 128]));
    add(
        "a hundred dimensions",
        &nrrd(&usual("4 4 4", "raw").replace("dimension: 3", "dimension: 100"), &[0; 128]),
    );
    add("half of its data", &nrrd(&usual("4 4 4", "raw"), &[0; 64]));
    add("gzip, 1 GiB of zeros for 4 x 4 x 4", &nrrd(&usual("4 4 4", "gzip"), bomb()));
    add("gzip, 1 GiB of zeros for 2^30 voxels", &nrrd(&usual("1024 1024 1024", "gzip"), bomb()));
    add("gzip, 1 GB of zeros for 800³, without the memory", largest());
    add("gzip, less than it says", &nrrd(&usual("800 800 800", "gzip"), &gzip(&[0; 64])));
    add("bzip2, 1 GiB of zeros in 8 kB", &nrrd(&usual("800 800 800", "bzip2"), &bzip2_bomb()));
    add("data that are no gzip", &nrrd(&usual("4 4 4", "gzip"), &[7; 128]));
    add("text of letters", &nrrd(&usual("4 4 4", "ascii"), &[b'x'; 1 << 20]));
    add("a header line of 2 MiB", &nrrd(&format!("content: {}", "x".repeat(2 << 20)), b""));
    add("a header without an end", &nrrd(&"#\n".repeat(1 << 20), b""));
    let elsewhere = |line: &str| nrrd(&format!("{}data file: {line}", usual("4 4 4", "raw")), b"");
    add("data in /etc/passwd", &elsewhere("/etc/passwd"));
    add("data in /dev/zero", &elsewhere("/dev/zero"));
    add("data in the folder above", &elsewhere("../../../../../../etc/passwd"));
    add("data in 10^12 files", &elsewhere("s%03d.raw 1 1000000000000 1"));
    add("a file name of 10^9 digits", &elsewhere("s%01000000000d.raw 1 4 1"));
    add("a list of files without an end", &elsewhere(&format!("LIST\n{}", "s.raw\n".repeat(1 << 18))));
}

fn other_volumes(cases: &mut Cases) {
    let mut add = |what: &str, name: &str, content: &[u8]| cases.volume(what, name, content);
    add("NIfTI: 32767³ voxels", "v.nii", &nifti([32767; 3], |_| {}));
    add("NIfTI: negative dimensions", "v.nii", &nifti([-4; 3], |_| {}));
    let offset =
        |value: f32| nifti([4; 3], move |header| header[108..112].copy_from_slice(&value.to_le_bytes()));
    add("NIfTI: data at 1e30", "v.nii", &offset(1e30));
    add("NIfTI: data at no number", "v.nii", &offset(f32::NAN));
    add(
        "NIfTI: axes that are no numbers",
        "v.nii",
        &nifti([4; 3], |h| h[280..284].copy_from_slice(&[0xff; 4])),
    );
    add("NIfTI: no data", "v.nii", &nifti([64; 3], |_| {}));
    add("NIfTI: gzip, a bomb for a header", "v.nii.gz", bomb());
    add("MetaImage: 2^40 voxels", "v.mhd", &mhd("1048576 1024 1024", "ElementDataFile = LOCAL"));
    add("MetaImage: data in /dev/zero", "v.mhd", &mhd("4 4 4", "ElementDataFile = /dev/zero"));
    add("MetaImage: its own header as data", "v.mhd", &mhd("800 800 800", "ElementDataFile = v.mhd"));
    let zlib = mhd("4 4 4", "CompressedData = True\nElementDataFile = LOCAL");
    add("MetaImage: zlib, a bomb", "v.mha", &[&zlib[..], bomb()].concat());
    let slice = DicomSlice::default().bytes();
    add("DICOM: cut in the middle", "v.dcm", &slice[..slice.len() / 2]);
    let prefix = &slice[..slice.len() - 52];
    // RequestAttributesSequence of undefined length.
    let endless = b"\x40\0\x75\x02SQ\0\0\xff\xff\xff\xff";
    let nested = [&endless[..], b"\xfe\xff\0\xe0\xff\xff\xff\xff"].concat().repeat(100_000);
    add("DICOM: 100,000 sequences in one another", "v.dcm", &[prefix, &nested].concat());
    let items = b"\xfe\xff\0\xe0\0\0\0\0".repeat(100_000);
    add("DICOM: a sequence without an end", "v.dcm", &[prefix, &endless[..], &items].concat());
    let long = [prefix, &[0x08, 0, 0x40, 0x11, b'O', b'W', 0, 0, 0xfe, 0xff, 0xff, 0xff]].concat();
    add("DICOM: an element of 4 GiB", "v.dcm", &long);
    let mut jpeg = LOSSLESS_JPEG.to_vec();
    jpeg[7..11].copy_from_slice(&[0x59, 0xd8, 0x59, 0xd8]);
    jpeg.splice(49..50, vec![0; 9000]);
    let encapsulated = |syntax: &'static str, fragment: Vec<u8>| DicomSlice {
        transfer_syntax: syntax,
        rows: 23000,
        columns: 23000,
        fragment: Some(fragment),
        ..DicomSlice::default()
    };
    let frame = |extent: u16, change: &dyn Fn(&mut Vec<u8>)| {
        let mut codestream = jpeg_2000(extent, extent);
        change(&mut codestream);
        DicomSlice { rows: extent, columns: extent, ..encapsulated(JPEG_2000_SYNTAXES[0], codestream) }
    };
    for (what, slice) in [
        ("DICOM: a JPEG of 23000² pixels in 9 kB", encapsulated("1.2.840.10008.1.2.4.70", jpeg)),
        (
            "DICOM: JPEG-LS of 23000² pixels in 64 bytes",
            encapsulated("1.2.840.10008.1.2.4.80", vec![0xff; 64]),
        ),
        ("DICOM: RLE of 23000² pixels in 64 bytes", encapsulated("1.2.840.10008.1.2.5", vec![1; 64])),
        ("DICOM: JPEG 2000 of 23000² pixels in 105 bytes", frame(23000, &|_| {})),
        (
            "DICOM: JPEG 2000 of 4294967295² pixels, of 8² in the slice",
            frame(8, &|data| data[8..16].fill(0xff)),
        ),
        (
            "DICOM: JPEG 2000 of 16 components",
            frame(8, &|data| {
                data[5] = 41 + 45;
                data[41] = 16;
                data.splice(45..45, [0x8f, 1, 1].repeat(15));
            }),
        ),
        (
            "DICOM: JPEG 2000 in tiles of 1 pixel",
            frame(2000, &|data| data[24..32].copy_from_slice(&[0, 0, 0, 1].repeat(2))),
        ),
        (
            "DICOM: JPEG 2000, 32 layers of precincts of 1 pixel",
            frame(2000, &|data| {
                data[45..59].copy_from_slice(&[0xff, 0x52, 0, 13, 1, 0, 0, 32, 0, 0, 4, 4, 0, 1]);
                data.insert(59, 0);
            }),
        ),
        ("DICOM: JPEG 2000, cut in its packet", frame(8, &|data| data.truncate(90))),
    ] {
        let folder = cases.path("series");
        fs::create_dir_all(&folder).unwrap();
        write_series(&folder, &[slice]);
        cases.add(what, "volume info", &folder);
    }
}

fn texts_and_logs(cases: &mut Cases) {
    let mut scene = |what: &str, content: &[u8]| {
        cases.file(&format!("scene: {what}"), "scene check", "s.toml", content);
    };
    scene("100,000 arrays in one another", format!("a = {}", "[".repeat(100_000)).as_bytes());
    scene("100,000 tables in one another", format!("a = {}", "{a=".repeat(100_000)).as_bytes());
    scene("a key of 100,000 parts", format!("{}a = 1", "a.".repeat(100_000)).as_bytes());
    scene("100,000 keys", (0..100_000).map(|n| format!("k{n} = 1\n")).collect::<String>().as_bytes());
    scene("17 MiB", &vec![b'#'; 17 << 20]);
    scene("a number of 1e999", b"name = \"a\"\n[run]\nmode = \"lockstep\"\nduration_s = 1e999\n");
    scene("no UTF-8", &[0xff; 1000]);
    let magic = b"\x89MCAP0\r\n";
    let record =
        |kind: u8, length: u64, body: &[u8]| [&magic[..], &[kind], &length.to_le_bytes(), body].concat();
    let mut log = |what: &str, content: &[u8]| {
        cases.file(&format!("MCAP: {what}"), "log info", "run.mcap", content);
    };
    log("empty", b"");
    log("its magic alone", magic);
    log("a header of 2^63 bytes", &record(1, 1 << 63, b""));
    log("a header of 2^64 - 1 bytes", &record(1, u64::MAX, b""));
    log("a header whose text has 4 GiB", &record(1, 8, &[0xff; 8]));
    log(
        "a chunk that unpacks to 2^60 bytes",
        &record(6, 64, &[&[0; 16][..], &(1_u64 << 60).to_le_bytes(), &[0; 40]].concat()),
    );
    log(
        "a million records of nothing",
        &[&magic[..], &[0x0f, 0, 0, 0, 0, 0, 0, 0, 0].repeat(1 << 20)].concat(),
    );
    log("zeros", &[&magic[..], &[0; 1 << 20]].concat());
    log("a footer that points nowhere", &[&record(2, 20, &[0xff; 20])[..], magic].concat());
}

/// How a command ended: its exit code, its first line of output, its peak memory and its time.
struct Verdict {
    code: Option<i32>,
    said: String,
    peak_bytes: u64,
    milliseconds: u128,
}

fn judge(case: &Case, place: &Place, most_kib: Option<u64>) -> Verdict {
    let file = |name: &str| File::create(place.path(name)).unwrap();
    let most = most_kib.map_or("unlimited".to_owned(), |kib| kib.to_string());
    let limited = format!("ulimit -v {most} && exec \"$@\"");
    let mut command = Command::new("sh");
    command.args(["-c", &limited, "sh", env!("CARGO_BIN_EXE_trabecula")]);
    command.args(&case.words).current_dir(place.path(""));
    command.stdin(Stdio::null()).stdout(file("out")).stderr(file("err"));
    let began = Instant::now();
    let mut child = command.spawn().unwrap();
    let status_file = format!("/proc/{}/status", child.id());
    let mut peak_bytes = 0;
    let status = wait_for(&format!("the end of {}", case.what), || {
        // The kernel's own peak, polled until shortly before the end.
        for _ in 0..4096 {
            let text = fs::read_to_string(&status_file).unwrap_or_default();
            let line = text.lines().find_map(|line| line.strip_prefix("VmHWM:"));
            let kilobytes = line.and_then(|line| line.trim().strip_suffix(" kB")?.parse::<u64>().ok());
            let Some(kilobytes) = kilobytes else { break };
            peak_bytes = peak_bytes.max(kilobytes * 1024);
        }
        child.try_wait().unwrap()
    });
    let milliseconds = began.elapsed().as_millis();
    let text = fs::read(place.path("err")).unwrap();
    let text = String::from_utf8(text).unwrap();
    Verdict {
        code: status.code(),
        said: text.lines().next().unwrap_or_default().to_owned(),
        peak_bytes,
        milliseconds,
    }
}

const HEAD: &str = "\
# Hostile files

Files that are not what they claim to be, each given to the command that reads it. Every one is rejected with a message and an exit code: 2
for bad input; for a log 1 (damaged) or 3 (cut). None makes its command use more than 512 MiB of address space, hang or panic. What a message
says: run the command on such a file. The rules behind it: [security.md](security.md#untrusted-volumes).
";
const LARGE: &str = "
## Large volumes in small files

Deflate shrinks empty voxels to a thousandth, and label maps are mostly empty, so growth alone does not tell a hostile file from a sparse one.
A file is rejected if it cannot hold what it claims (at most 1032 bytes per byte), if it then does not, if it holds more, or if there is no
memory for the voxels. These are read: at most 2^29 voxels, two bytes of memory each. Processor time and peak memory of one run:

| file | exit code | s | MB |
|---|---|---|---|
";
const TAIL: &str = "
<details markdown=\"1\"><summary>How this is verified</summary>

`cargo test --release --test processes -- hostile` builds every file of these tables, runs the command with that limit, and compares exit codes.

</details>
";

/// Returns the page: the rejected files by command, then the cost of the large volumes.
fn page(refused: &[(Case, Verdict)], read: &[(Case, Verdict)]) -> String {
    let mut page = HEAD.to_owned();
    let command_of = |case: &Case| case.words[..case.words.len() - 1].join(OsStr::new(" "));
    let mut commands: Vec<OsString> = Vec::new();
    for (case, _) in refused {
        let command = command_of(case);
        if !commands.contains(&command) {
            commands.push(command);
        }
    }
    for command in commands {
        page += &format!("\n`trabecula {}`:\n\n| file | exit code |\n|---|---|\n", command.display());
        for (case, verdict) in refused.iter().filter(|(case, _)| command_of(case) == command) {
            page += &format!("| {} | {} |\n", case.what, verdict.code.unwrap_or(-1));
        }
    }
    page += LARGE;
    for (case, verdict) in read {
        let (code, s) = (verdict.code.unwrap_or(-1), verdict.milliseconds as f64 * 1e-3);
        page += &format!("| {} | {code} | {s:.0} | {:.0} |\n", case.what, verdict.peak_bytes as f64 * 1e-6);
    }
    page + TAIL
}

#[test]
fn every_hostile_file_is_refused_in_bounded_memory() {
    let mut cases = Cases { place: Place::new(), all: Vec::new() };
    of_no_format(&mut cases);
    nrrd_files(&mut cases);
    other_volumes(&mut cases);
    texts_and_logs(&mut cases);
    assert!(cases.all.len() >= 60, "{} files", cases.all.len());
    let refused = cases.all.len();
    cases.volume("NRRD: gzip, 1 GB of zeros for 800³", "v.nrrd", largest());
    let labels = mhd("800 800 800", "CompressedData = True\nElementDataFile = LOCAL");
    let labels = String::from_utf8(labels).unwrap().replace("MET_SHORT", "MET_UCHAR");
    let labels = [labels.as_bytes(), &zlib_labels(800)].concat();
    cases.volume("MetaImage: zlib, a sparse label map of 800³", "v.mha", &labels);
    let Cases { place, all } = cases;
    let judged = |(n, case): (usize, Case)| {
        let verdict = judge(&case, &place, (n < refused).then_some(MOST_KIB));
        (case, verdict)
    };
    let mut rows: Vec<(Case, Verdict)> = all.into_iter().enumerate().map(judged).collect();
    let read = rows.split_off(refused);
    let page = page(&rows, &read);
    println!("{page}");
    for (case, verdict) in &read {
        assert_eq!(verdict.code, Some(0), "{}: {}", case.what, verdict.said);
        // The voxels, a tenth more, and the program.
        assert!(verdict.peak_bytes < 1_024_000_000 / 10 * 11 + (64 << 20), "{}", verdict.peak_bytes);
    }
    for (case, verdict) in &rows {
        let (what, said) = (&case.what, &verdict.said);
        // For a log, 1 means damaged and 3 truncated; every other file is bad input.
        let is_log = case.words[0] == "log";
        let refused = verdict.code == Some(2) || (is_log && [Some(1), Some(3)].contains(&verdict.code));
        assert!(refused, "{what}: {:?}, {said}", verdict.code);
        assert!(!said.is_empty() || is_log, "{what}: nothing is said");
        assert!(!said.contains("panicked"), "{what}: {said}");
    }
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(PAGE);
    if std::env::var_os("WRITE_TABLE").is_some() {
        fs::write(&path, page).unwrap();
        return;
    }
    let written = fs::read_to_string(&path).unwrap();
    for (case, verdict) in rows.iter().chain(&read) {
        let row = written.lines().find(|line| line.starts_with(&format!("| {} |", case.what)));
        let row = row.unwrap_or_else(|| panic!("{PAGE} lacks {}; write it with WRITE_TABLE=1", case.what));
        let code = format!("| {} |", verdict.code.unwrap_or(-1));
        assert!(row.contains(&code), "{PAGE}: {row}: the exit code is {:?}", verdict.code);
    }
}
