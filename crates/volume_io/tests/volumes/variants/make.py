"""Writes volumes with other programs, and the result of two independent readers for each.

    python make.py FOLDER

FOLDER/cases.json lists the cases; each reader's voxels are beside it as little-endian int32, i fastest, in file order.
"""

import json
import pathlib
import shutil
import subprocess
import sys

import nibabel
import nrrd
import numpy as np
import pydicom
import SimpleITK as sitk
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.sequence import Sequence
from pydicom.uid import (
    CTImageStorage,
    DeflatedExplicitVRLittleEndian,
    EnhancedCTImageStorage,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
    JPEG2000,
    JPEG2000Lossless,
    JPEGLSLossless,
    JPEGLSNearLossless,
    RLELossless,
)

FOLDER = pathlib.Path(sys.argv[1])
CASES = []
COUNT = iter(range(1, 10**6))

# What is stored: k, j, i; smooth tissue, noise, and a bright and a dark block.
K, J, I = 7, 37, 45
RNG = np.random.default_rng(25)
kk, jj, ii = np.mgrid[0:K, 0:J, 0:I]
HU = np.rint(300 * np.sin(ii / 3.0) + 40 * jj - 25 * kk + RNG.normal(0, 15, (K, J, I))).astype(np.int16)
HU[2:4, 3:6, 4:8] = 1900
HU[:, :2, :] = -1000
SPACING = (0.7, 0.8, 1.5)  # i, j, k
ORIGIN = (-12.5, 20.25, -300.0)


def case(name, file, format, feature, written_by, readers, options=None, tolerance=0):
    """readers: name -> (array k j i, affine 4x4 in LPS mm or None)."""
    entry = dict(
        name=name, file=str(file), format=format, feature=feature, written_by=written_by,
        options=options or {}, tolerance=tolerance, readers=[],
    )
    for reader, (array, affine) in readers.items():
        array = np.asarray(array)
        assert array.ndim == 3, (name, reader, array.shape)
        path = FOLDER / f"{name}.{reader.split()[0]}.i32"
        np.ascontiguousarray(np.rint(array)).astype("<i4").tofile(path)
        entry["readers"].append(dict(
            name=reader, voxels=str(path), dims=list(array.shape[::-1]),
            affine_mm=None if affine is None else np.asarray(affine, float).tolist(),
        ))
    CASES.append(entry)


def folder(name):
    path = FOLDER / name
    path.mkdir()
    return path


# Readers

def sitk_affine(image):
    n = 3
    direction = np.array(image.GetDirection()).reshape(image.GetDimension(), -1)[:n, :n]
    affine = np.eye(4)
    affine[:3, :3] = direction * np.array(image.GetSpacing()[:n])
    affine[:3, 3] = image.GetOrigin()[:n]
    return affine


def by_sitk(path):
    image = sitk.ReadImage(str(path))
    array = sitk.GetArrayFromImage(image)
    return (array[0] if array.ndim == 4 else array), sitk_affine(image)


def by_sitk_series(paths):
    reader = sitk.ImageSeriesReader()
    reader.SetFileNames([str(path) for path in paths])
    image = reader.Execute()
    return sitk.GetArrayFromImage(image), sitk_affine(image)


def by_nibabel(path):
    image = nibabel.load(str(path))
    array = np.asarray(image.dataobj)
    if array.ndim == 4:
        array = array[..., 0]
    affine = np.diag([-1.0, -1.0, 1.0, 1.0]) @ image.affine
    return array.transpose(2, 1, 0), affine


SPACE_TO_LPS = {
    "left-posterior-superior": (1, 1, 1), "right-anterior-superior": (-1, -1, 1), "left-anterior-superior": (1, -1, 1),
    "3D-right-handed": (1, 1, 1), "scanner-xyz": (1, 1, 1),
}


def by_pynrrd(path, layer=None, time_axis=None):
    data, header = nrrd.read(str(path), index_order="F")
    directions = np.array(header["space directions"], float)
    if data.ndim == 4:
        axis = 0 if layer is not None else 3
        data = np.take(data, layer or 0, axis=axis)
        directions = np.delete(directions, axis, axis=0)
    affine = np.eye(4)
    sign = np.array(SPACE_TO_LPS[header["space"]], float)
    affine[:3, :3] = (directions * sign).T
    affine[:3, 3] = np.array(header.get("space origin", [0, 0, 0]), float) * sign
    return data.transpose(2, 1, 0), affine


def by_pydicom(paths):
    """Classic slices in their order along the normal."""
    slices = [pydicom.dcmread(str(path), force=True) for path in paths]
    for s in slices:
        if "TransferSyntaxUID" not in s.file_meta:
            s.file_meta.TransferSyntaxUID = (
                ImplicitVRLittleEndian if s.original_encoding[0] else ExplicitVRLittleEndian
            )
    orientation = np.array(slices[0].ImageOrientationPatient, float)
    row, column = orientation[:3], orientation[3:]
    normal = np.cross(row, column)
    slices.sort(key=lambda s: float(np.dot(np.array(s.ImagePositionPatient, float), normal)))
    array = np.stack([
        s.pixel_array.astype(float) * float(s.RescaleSlope) + float(s.RescaleIntercept) for s in slices
    ])
    first, last = (np.array(s.ImagePositionPatient, float) for s in (slices[0], slices[-1]))
    affine = np.eye(4)
    dj, di = (float(v) for v in slices[0].PixelSpacing)
    affine[:3, 0], affine[:3, 1] = row * di, column * dj
    affine[:3, 2] = (last - first) / (len(slices) - 1)
    affine[:3, 3] = first
    return array, affine


# DICOM

def uid():
    return f"1.2.826.0.1.3680043.10.1234.{next(COUNT)}"


STUDY, SERIES = uid(), uid()


def ct_slice(k, array, series=SERIES, position=None, syntax=ExplicitVRLittleEndian, bits=16, signed=True, intercept=0,
             stored=None, image_type="ORIGINAL\\PRIMARY\\AXIAL", description="chest"):
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = CTImageStorage
    meta.MediaStorageSOPInstanceUID = uid()
    meta.TransferSyntaxUID = syntax
    d = Dataset()
    d.file_meta = meta
    d.SOPClassUID = CTImageStorage
    d.SOPInstanceUID = meta.MediaStorageSOPInstanceUID
    d.ImageType = image_type.split("\\")
    d.Modality = "CT"
    d.SeriesDescription = description
    d.PatientName, d.PatientID = "A^B", "1"
    d.StudyInstanceUID, d.SeriesInstanceUID = STUDY, series
    d.InstanceNumber = k + 1
    d.ImagePositionPatient = [f"{v:.6g}" for v in (position or (ORIGIN[0], ORIGIN[1], ORIGIN[2] + SPACING[2] * k))]
    d.ImageOrientationPatient = ["1", "0", "0", "0", "1", "0"]
    d.PixelSpacing = [str(SPACING[1]), str(SPACING[0])]
    d.SliceThickness = str(SPACING[2])
    d.SamplesPerPixel, d.PhotometricInterpretation = 1, "MONOCHROME2"
    d.Rows, d.Columns = array.shape
    d.BitsAllocated = 32 if array.dtype.itemsize == 4 else (8 if array.dtype.itemsize == 1 else 16)
    d.BitsStored = stored or bits
    d.HighBit = d.BitsStored - 1
    d.PixelRepresentation = 1 if signed else 0
    d.RescaleSlope, d.RescaleIntercept = "1", str(intercept)
    d.PixelData = array.tobytes()
    d["PixelData"].VR = "OW"
    return d


def save(dataset, path):
    dataset.save_as(str(path), enforce_file_format=True)
    return path


def series_of(name, make):
    where = folder(name)
    return where, [save(make(k), where / f"{k:03}.dcm") for k in range(K)]


def dicom_case(name, feature, make, written_by="pydicom", tolerance=0, sitk_too=True, options=None):
    where, paths = series_of(name, make)
    readers = {"pydicom": by_pydicom(paths)}
    if sitk_too:
        readers["SimpleITK (GDCM)"] = by_sitk_series(paths)
    case(name, where, "DICOM", feature, written_by, readers, options, tolerance)


UNSIGNED = (HU.astype(np.int32) + 1024).astype(np.uint16)


def plain(k, **more):
    return ct_slice(k, HU[k], **more)


def packed(syntax, signed, **options):
    def make(k):
        d = ct_slice(k, HU[k]) if signed else ct_slice(k, UNSIGNED[k], signed=False, stored=12, intercept=-1024)
        d.compress(syntax, generate_instance_uid=False, **options)
        return d
    return make


def implicit(k):
    return ct_slice(k, HU[k], syntax=ImplicitVRLittleEndian)


def big_endian(k):
    d = ct_slice(k, HU[k].astype(">i2"), syntax=ExplicitVRBigEndian)
    return d


dicom_case("dicom_explicit", "explicit VR little-endian", plain)
dicom_case("dicom_implicit", "implicit VR little-endian", implicit)
dicom_case("dicom_big", "explicit VR big-endian", big_endian)
dicom_case("dicom_deflated", "deflated", lambda k: ct_slice(k, HU[k], syntax=DeflatedExplicitVRLittleEndian))
dicom_case("dicom_rle", "RLE lossless", packed(RLELossless, True))
dicom_case("dicom_jls", "JPEG-LS lossless, signed 16 bits", packed(JPEGLSLossless, True))
dicom_case("dicom_jls_12", "JPEG-LS lossless, unsigned 12 bits", packed(JPEGLSLossless, False))
dicom_case("dicom_jls_near", "JPEG-LS near-lossless, 12 bits", packed(JPEGLSNearLossless, False, jls_error=3))
# JPEG 2000: pydicom and GDCM both unpack it with OpenJPEG, so what was written is the second reader where
# nothing is lost. Where it is, OpenJPEG's 9-7 transform scales one band by 1.625732 for the 1.625786 of T.800
# (2/K), and rounding differs: 1 HU.
BYTES = (UNSIGNED >> 4).astype(np.uint8)
J2K_AFFINE = np.diag([*SPACING, 1.0])
J2K_AFFINE[:3, 3] = ORIGIN


def j2k_lossless(name, feature, voxels, **header):
    def make(k):
        d = ct_slice(k, voxels[k], **header)
        d.compress(JPEG2000Lossless, generate_instance_uid=False)
        return d
    where, paths = series_of(name, make)
    written = (voxels.astype(int) + header.get("intercept", 0), J2K_AFFINE)
    case(name, where, "DICOM", f"JPEG 2000 lossless, {feature}", "pydicom", {
        "pydicom": by_pydicom(paths), "SimpleITK (GDCM)": by_sitk_series(paths), "numpy (what was written)": written})


j2k_lossless("dicom_j2k", "signed 16 bits", HU)
j2k_lossless("dicom_j2k_12", "unsigned 12 bits", UNSIGNED, signed=False, stored=12, intercept=-1024)
j2k_lossless("dicom_j2k_s12", "signed 12 bits", HU.clip(-2048, 2047), bits=12)
j2k_lossless("dicom_j2k_8", "unsigned 8 bits", BYTES, bits=8, signed=False, intercept=-1024)
NOISE = RNG.integers(-32768, 32768, HU.shape).astype(np.int16)
j2k_lossless("dicom_j2k_noise", "signed 16 bits, noise of all values", NOISE)
for name, feature, syntax, options in [
    ("dicom_j2k_lossy", "JPEG 2000, 12 bits, a tenth of the bytes", JPEG2000, dict(j2k_cr=[10])),
    ("dicom_j2k_layers", "JPEG 2000, 12 bits, three layers", JPEG2000, dict(j2k_cr=[40, 20, 10])),
]:
    dicom_case(name, feature, packed(syntax, False, **options), tolerance=1)
dicom_case("dicom_j2k_lossy_signed", "JPEG 2000, signed 16 bits", packed(JPEG2000, True, j2k_psnr=[80]), tolerance=1)
dicom_case(
    "dicom_32", "32 bits allocated", lambda k: ct_slice(k, HU[k].astype(np.int32), bits=32),
)


def by_gdcm(paths, where, syntax, codec=None):
    """The files again, packed by GDCM."""
    import gdcm
    for path in paths:
        reader = gdcm.ImageReader()
        reader.SetFileName(str(path))
        assert reader.Read()
        change = gdcm.ImageChangeTransferSyntax()
        change.SetTransferSyntax(gdcm.TransferSyntax(syntax))
        if codec:
            change.SetUserCodec(codec)
        change.SetInput(reader.GetImage())
        assert change.Change(), syntax
        writer = gdcm.ImageWriter()
        writer.SetFileName(str(where / path.name))
        writer.SetFile(reader.GetFile())
        writer.SetImage(change.GetOutput())
        assert writer.Write()
    return sorted(where.glob("*.dcm"))


def gdcm_case(name, feature, syntax, signed, tolerance=0, codec=None):
    make = plain if signed else (lambda k: ct_slice(k, UNSIGNED[k], signed=False, stored=12, intercept=-1024))
    _, paths = series_of(f"{name}_source", make)
    where = folder(name)
    paths = by_gdcm(paths, where, syntax, codec)
    readers = {"pydicom": by_pydicom(paths), "SimpleITK (GDCM)": by_sitk_series(paths)}
    case(name, where, "DICOM", feature, "GDCM", readers, None, tolerance)


import gdcm  # noqa: E402

gdcm_case("gdcm_lossless", "JPEG lossless (process 14, SV1)", gdcm.TransferSyntax.JPEGLosslessProcess14_1, False)
gdcm_case("gdcm_rle", "RLE lossless", gdcm.TransferSyntax.RLELossless, True)
gdcm_case("gdcm_jls", "JPEG-LS lossless", gdcm.TransferSyntax.JPEGLSLossless, True)
gdcm_case("gdcm_j2k", "JPEG 2000 lossless", gdcm.TransferSyntax.JPEG2000Lossless, True)
tiled = gdcm.JPEG2000Codec()
tiled.SetTileSize(16, 16)
tiled.SetNumberOfResolutions(3)
gdcm_case("gdcm_j2k_tiles", "JPEG 2000 lossless, tiles of 16 x 16", gdcm.TransferSyntax.JPEG2000Lossless, True, codec=tiled)
lossy = gdcm.JPEG2000Codec()
lossy.SetReversible(False)
lossy.SetRate(0, 8.0)
gdcm_case("gdcm_j2k_lossy", "JPEG 2000, an eighth of the bytes", gdcm.TransferSyntax.JPEG2000, False, 1, lossy)
# 12-bit JPEG is written by dcmtk alone, a Debian package. pydicom's decoder transforms in another precision
# than libjpeg, which dcmtk has.
if shutil.which("dcmcjpeg"):
    make = lambda k: ct_slice(k, UNSIGNED[k], signed=False, stored=12, intercept=-1024)
    _, paths = series_of("dcmtk_source", make)
    where, plain_again = folder("dcmtk_jpeg12"), folder("dcmtk_decoded")
    for path in paths:
        subprocess.run(["dcmcjpeg", "+ee", "+q", "90", path, where / path.name], check=True)
        subprocess.run(["dcmdjpeg", where / path.name, plain_again / path.name], check=True)
    packed_paths = sorted(where.glob("*.dcm"))
    case("dcmtk_jpeg12", where, "DICOM", "JPEG extended, 12 bits", "dcmtk", {
        "pydicom": by_pydicom(packed_paths), "dcmtk (dcmdjpeg)": by_pydicom(sorted(plain_again.glob("*.dcm")))}, None, 1)

# No preamble: the file meta group at once, and no meta group at all.
# GDCM takes none of these; what it reads are the same files before the bytes were taken off.
where, paths = series_of("dicom_no_preamble", plain)
before = by_sitk_series(paths)
for path in paths:
    path.write_bytes(path.read_bytes()[132:])
case("dicom_no_preamble", where, "DICOM", "no preamble, file meta group first", "pydicom, first 132 bytes off", {
    "pydicom": by_pydicom(paths), "SimpleITK (GDCM) before": before})
for name, make, what in [("dicom_bare_explicit", plain, "explicit"), ("dicom_bare_implicit", implicit, "implicit")]:
    where, paths = series_of(name, make)
    before = by_sitk_series(paths)
    for path in paths:
        d = pydicom.dcmread(str(path))
        length = d.file_meta.FileMetaInformationGroupLength
        path.write_bytes(path.read_bytes()[132 + 12 + length:])
    case(name, where, "DICOM", f"no preamble and no file meta group, {what} VR", "pydicom, group 2 off", {
        "pydicom": by_pydicom(paths), "SimpleITK (GDCM) before": before})

# A folder of a study: two series in folders of their own, a localizer in the series that is read, a report.
where = folder("dicom_study")
(where / "a").mkdir()
(where / "b/deep").mkdir(parents=True)
other = uid()
paths = [save(plain(k), where / "a" / f"{k:03}.dcm") for k in range(K)]
for k in range(3):
    save(ct_slice(k, HU[k] + 5, series=other, description="bone kernel"), where / "b/deep" / f"{k:03}.dcm")
scout = ct_slice(99, HU[0], image_type="ORIGINAL\\PRIMARY\\LOCALIZER", position=(0, 0, 0))
scout.ImageOrientationPatient = ["1", "0", "0", "0", "0", "-1"]
del scout.PixelSpacing
save(scout, where / "a" / "scout.dcm")
report = ct_slice(0, HU[0], series=uid())
for key in ["Rows", "Columns", "PixelData"]:
    del report[key]
report.Modality = "SR"
save(report, where / "report.dcm")
case("dicom_study", where, "DICOM", "two series in subfolders, one chosen; localizer; report", "pydicom", {
    "pydicom": by_pydicom(paths), "SimpleITK (GDCM)": by_sitk_series(paths)}, {"series": SERIES})

# Uneven spacing and gantry tilt, resampled; what they become is computed here by numpy.
heights = np.array([0, 1.5, 3.0, 5.5, 7.0, 8.5, 10.0])
where, paths = series_of(
    "dicom_uneven", lambda k: ct_slice(k, HU[k], position=(ORIGIN[0], ORIGIN[1], ORIGIN[2] + heights[k])))
# The smallest distance, 1.5 mm, or a little less so that the last slice lies on the grid.
target = np.linspace(0, heights[-1], 8)
flat = HU.reshape(K, -1).astype(float)
even = np.stack([np.interp(target, heights, flat[:, p]) for p in range(flat.shape[1])], 1).reshape(len(target), J, I)
affine = np.diag([*SPACING, 1.0])
affine[:3, 3] = ORIGIN
case("dicom_uneven", where, "DICOM", "uneven slices, `resample = \"rectify\"`", "pydicom", {
    "numpy (interp)": (even, affine @ np.diag([1, 1, heights[-1] / 7 / SPACING[2], 1]))}, {"rectify": True}, 1)
shift = np.arange(K) * 0.4
where, paths = series_of(
    "dicom_tilt",
    lambda k: ct_slice(k, HU[k], position=(ORIGIN[0], ORIGIN[1] + shift[k], ORIGIN[2] + SPACING[2] * k)))
rows = J + int(np.ceil(shift[-1] / SPACING[1] - 1e-6))
upright = np.full((K, rows, I), -1000.0)
for k in range(K):
    source = SPACING[1] * np.arange(J) + shift[k]
    at = SPACING[1] * np.arange(rows)
    inside = (at >= source[0] - 1e-6) & (at <= source[-1] + 1e-6)
    for i in range(I):
        upright[k, inside, i] = np.interp(at[inside], source, HU[k, :, i].astype(float))
case("dicom_tilt", where, "DICOM", "gantry tilt, `resample = \"rectify\"`", "pydicom", {
    "numpy (interp)": (upright, affine)}, {"rectify": True}, 1)


# Enhanced CT
def enhanced(order, rescale_per_frame):
    d = ct_slice(0, HU[0])
    d.file_meta.MediaStorageSOPClassUID = d.SOPClassUID = EnhancedCTImageStorage
    d.ImageType = ["ORIGINAL", "PRIMARY", "VOLUME", "NONE"]
    for key in ["ImagePositionPatient", "ImageOrientationPatient", "PixelSpacing", "SliceThickness", "RescaleSlope",
                "RescaleIntercept"]:
        del d[key]
    d.NumberOfFrames = K
    d.PixelData = HU[order].tobytes()
    shared = Dataset()
    measures = Dataset()
    measures.PixelSpacing = [str(SPACING[1]), str(SPACING[0])]
    measures.SliceThickness = str(SPACING[2])
    shared.PixelMeasuresSequence = Sequence([measures])
    orientation = Dataset()
    orientation.ImageOrientationPatient = ["1", "0", "0", "0", "1", "0"]
    shared.PlaneOrientationSequence = Sequence([orientation])
    transformation = Dataset()
    transformation.RescaleSlope, transformation.RescaleIntercept, transformation.RescaleType = "1", "0", "HU"
    if not rescale_per_frame:
        shared.PixelValueTransformationSequence = Sequence([transformation])
    d.SharedFunctionalGroupsSequence = Sequence([shared])
    frames = []
    for k in order:
        position = Dataset()
        position.ImagePositionPatient = [f"{v:.6g}" for v in (ORIGIN[0], ORIGIN[1], ORIGIN[2] + SPACING[2] * k)]
        frame = Dataset()
        frame.PlanePositionSequence = Sequence([position])
        if rescale_per_frame:
            frame.PixelValueTransformationSequence = Sequence([transformation])
        frames.append(frame)
    d.PerFrameFunctionalGroupsSequence = Sequence(frames)
    return d


def by_pydicom_enhanced(path):
    d = pydicom.dcmread(str(path))
    z = [float(f.PlanePositionSequence[0].ImagePositionPatient[2]) for f in d.PerFrameFunctionalGroupsSequence]
    return d.pixel_array[np.argsort(z)], affine


order = list(range(K))
for name, feature, order, syntax in [
    ("enhanced", "enhanced multi-frame", list(range(K)), None),
    ("enhanced_shuffled", "enhanced multi-frame, frames in another order", [3, 0, 6, 1, 5, 2, 4], None),
    ("enhanced_jls", "enhanced multi-frame, JPEG-LS", list(range(K)), JPEGLSLossless),
    ("enhanced_rle", "enhanced multi-frame, RLE", list(range(K)), RLELossless),
    ("enhanced_j2k", "enhanced multi-frame, JPEG 2000 lossless", list(range(K)), JPEG2000Lossless),
]:
    d = enhanced(order, name == "enhanced_jls")
    if syntax:
        d.compress(syntax, generate_instance_uid=False)
    path = save(d, folder(name) / "ct.dcm")
    readers = {"pydicom": by_pydicom_enhanced(path)}
    if name != "enhanced_shuffled":  # GDCM hands the frames out as they are stored.
        readers["SimpleITK (GDCM)"] = (sitk.GetArrayFromImage(sitk.ReadImage(str(path))), None)
    case(name, path, "DICOM", feature, "pydicom", readers)

# NRRD

IMAGE = sitk.GetImageFromArray(HU)
IMAGE.SetSpacing(SPACING)
IMAGE.SetOrigin(ORIGIN)
TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
IMAGE.SetDirection(TURN.ravel().tolist())


WRITTEN = "numpy (what was written)"
AFFINE = np.diag([*SPACING, 1.0])
AFFINE[:3, 3] = ORIGIN


def nrrd_case(name, feature, path, written_by, pynrrd_too=True, options=None, readers=None, **more):
    if readers is None:
        readers = {"SimpleITK (teem)": by_sitk(path)}
        if pynrrd_too:
            readers["pynrrd"] = by_pynrrd(path, **more)
        else:
            readers[WRITTEN] = (HU, None)
    case(name, path, "NRRD", feature, written_by, readers, options)


GEOMETRY = (
    "space directions: (0.7,0,0) (0,0.8,0) (0,0,1.5)\nspace origin: (-12.5,20.25,-300)\n"
)
SIZES = f"sizes: {I} {J} {K}\n"
BYTES = HU.astype("<i2").tobytes()


def header(encoding, space="left-posterior-superior", sizes=SIZES, dimension=3, geometry=GEOMETRY, more=""):
    return (
        f"NRRD0005\ntype: short\ndimension: {dimension}\nspace: {space}\n{sizes}{geometry}"
        f"kinds: {'domain ' * 3}{'list' if dimension == 4 else ''}\nendian: little\nencoding: {encoding}\n{more}"
    ).encode()


for name, compressed in [("raw", False), ("gzip", True)]:
    path = FOLDER / f"{name}.nrrd"
    sitk.WriteImage(IMAGE, str(path), compressed)
    nrrd_case(f"nrrd_{name}", f"attached, {name}", path, "SimpleITK")
for encoding in ["bzip2", "ascii"]:
    path = FOLDER / f"{encoding}.nrrd"
    nrrd.write(str(path), HU.transpose(2, 1, 0), {
        "encoding": encoding, "space": "right-anterior-superior", "space origin": [1.0, 2.0, 3.0],
        "space directions": np.diag([-0.7, -0.8, 1.5])}, index_order="F")
    # ITK is built without bzip2.
    second = {WRITTEN: (HU, None)} if encoding == "bzip2" else {
        "SimpleITK (teem)": by_sitk(path)}
    nrrd_case(f"nrrd_{encoding}", f"attached, {encoding}, RAS", path, "pynrrd",
              readers={"pynrrd": by_pynrrd(path), **second})
path = FOLDER / "hex.nrrd"
path.write_bytes(header("hex") + b"\n" + BYTES.hex().encode())
nrrd_case("nrrd_hex", "hex", path, "text", pynrrd_too=False)
for space in ["3D-right-handed", "scanner-xyz"]:
    path = FOLDER / f"{space}.nrrd"
    path.write_bytes(header("raw", space=space) + b"\n" + BYTES)
    nrrd_case(f"nrrd_{space}", f"space {space}", path, "text")
parts = folder("parts")
for k in range(K):
    (parts / f"s{k + 1:03}.raw").write_bytes(HU[k].astype("<i2").tobytes())
path = parts / "list.nhdr"
path.write_bytes(header("raw", more="data file: LIST\n" + "".join(f"s{k + 1:03}.raw\n" for k in range(K))))
nrrd_case("nrrd_list", "data file: LIST", path, "text", pynrrd_too=False)
path = parts / "pattern.nhdr"
path.write_bytes(header("raw", more=f"data file: s%03d.raw 1 {K} 1\n"))
nrrd_case("nrrd_pattern", "data file: s%03d.raw 1 7 1", path, "text", pynrrd_too=False)
path = FOLDER / "one_time.nrrd"
four = GEOMETRY.replace("(0,0,1.5)", "(0,0,1.5) none")
path.write_bytes(header("raw", dimension=4, sizes=f"sizes: {I} {J} {K} 1\n", geometry=four) + b"\n" + BYTES)
nrrd_case("nrrd_one_time", "4D with one time", path, "text", time_axis=3)
for centers in ["cell", "node", None]:
    more = "axis mins: 10 20 30\nspacings: 0.7 0.8 1.5\n"
    more += f"centers: {centers} {centers} {centers}\n" if centers else ""
    text = f"NRRD0005\ntype: short\ndimension: 3\n{SIZES}{more}endian: little\nencoding: raw\n\n"
    path = FOLDER / f"mins_{centers}.nrrd"
    path.write_bytes(text.encode() + BYTES)
    nrrd_case(f"nrrd_mins_{centers}", f"axis mins, {centers or 'unnamed'} centers", path, "text", pynrrd_too=False)
padded = FOLDER / "padded.nrrd"
padded.write_bytes((FOLDER / "gzip.nrrd").read_bytes() + bytes(512))
nrrd_case("nrrd_padded", "gzip, zero padding behind it", padded, "SimpleITK, 512 zeros more", pynrrd_too=False)

# Segmentations of Slicer, as its exporter names the fields.
LABELS = np.zeros((K, J, I), np.uint8)
LABELS[1:5, 2:8, 3:9] = 1
LABELS[2:4, 3:5, 4:6] = 3
OTHER = np.zeros((K, J, I), np.uint8)
OTHER[0:3, 1:5, 2:11] = 1
SEGMENTS = {
    "Segment0_ID": "Segment_1", "Segment0_Name": "femur", "Segment0_LabelValue": "1", "Segment0_Layer": "0",
    "Segment1_ID": "Segment_2", "Segment1_Name": "implant", "Segment1_LabelValue": "3", "Segment1_Layer": "0",
}
space = {"space": "left-posterior-superior", "space origin": [1.0, 2.0, 3.0], "encoding": "gzip"}
path = FOLDER / "one.seg.nrrd"
nrrd.write(str(path), LABELS.transpose(2, 1, 0), {
    **space, "kinds": ["domain"] * 3, "space directions": np.diag([0.7, 0.8, 1.5]), **SEGMENTS}, index_order="F")


def only(read, value):
    array, where = read
    return (np.asarray(array) == value).astype(int), where


for label, value in [("femur", 1), ("implant", 3), (3, 3)]:
    nrrd_case(f"seg_{label}", f".seg.nrrd, `label = {json.dumps(label)}`", path, "pynrrd", options={"label": label},
              readers={"SimpleITK (teem)": only(by_sitk(path), value), "pynrrd": only(by_pynrrd(path), value)})
path = FOLDER / "layers.seg.nrrd"
layered = np.stack([LABELS.transpose(2, 1, 0), OTHER.transpose(2, 1, 0)])
nrrd.write(str(path), layered, {
    **space, "kinds": ["list", "domain", "domain", "domain"],
    "space directions": np.vstack([[np.nan] * 3, np.diag([0.7, 0.8, 1.5])]), **SEGMENTS,
    "Segment2_ID": "Segment_3", "Segment2_Name": "shaft", "Segment2_LabelValue": "1", "Segment2_Layer": "1",
}, index_order="F")
vector = sitk.ReadImage(str(path))
for label, value, layer in [("femur", 1, 0), ("shaft", 1, 1)]:
    component = sitk.VectorIndexSelectionCast(vector, layer)
    nrrd_case(f"layers_{label}", f".seg.nrrd of two layers, `label = \"{label}\"`", path, "pynrrd",
              options={"label": label}, readers={
                  "SimpleITK (teem)": only((sitk.GetArrayFromImage(component), sitk_affine(component)), value),
                  "pynrrd": only(by_pynrrd(path, layer=layer), value)})

# MetaImage. The second reader is the array that was written: no other library than MetaIO reads this format.

META_AFFINE = sitk_affine(IMAGE)


def meta_case(name, feature, path, written_by, where=META_AFFINE):
    case(name, path, "MetaImage", feature, written_by, {
        "SimpleITK (MetaIO)": by_sitk(path), WRITTEN: (HU, where)})


for name, feature, compressed in [("a.mha", "local, raw", False), ("z.mha", "local, zlib", True),
                                  ("a.mhd", "data file, raw", False)]:
    path = FOLDER / name
    sitk.WriteImage(IMAGE, str(path), compressed)
    meta_case(f"meta_{name}", feature, path, "SimpleITK")
META = (
    "ObjectType = Image\nNDims = {dims}\nBinaryData = True\nBinaryDataByteOrderMSB = False\nCompressedData = False\n"
    "TransformMatrix = {matrix}\nOffset = {offset}\nElementSpacing = {spacing}\nDimSize = {sizes}\n"
    "ElementType = MET_SHORT\nElementDataFile = {file}"
)
three = dict(dims=3, matrix="1 0 0 0 1 0 0 0 1", offset="-12.5 20.25 -300", spacing="0.7 0.8 1.5", sizes=f"{I} {J} {K}")
path = parts / "list.mhd"
path.write_text(META.format(file="LIST\n" + "".join(f"s{k + 1:03}.raw\n" for k in range(K)), **three))
meta_case("meta_list", "ElementDataFile = LIST", path, "text", affine)
path = parts / "pattern.mhd"
path.write_text(META.format(file=f"s%03d.raw 1 {K} 1\n", **three))
meta_case("meta_pattern", "ElementDataFile = s%03d.raw 1 7 1", path, "text", affine)
path = FOLDER / "time.mha"
four = sitk.JoinSeries([IMAGE])
sitk.WriteImage(four, str(path))
meta_case("meta_time", "4D with one time", path, "SimpleITK")

# NIfTI

RAS = np.diag([-1.0, -1.0, 1.0, 1.0]) @ META_AFFINE


def nifti_case(name, feature, path, written_by, options=None, sitk_too=True):
    readers = {"nibabel": by_nibabel(path)}
    # ITK takes no NIfTI-2.
    readers |= {"SimpleITK (NIfTI)": by_sitk(path)} if sitk_too else {WRITTEN: (HU, None)}
    case(name, path, "NIfTI", feature, written_by, readers, options)


def nifti_file(name, array, matrix, kind=nibabel.Nifti1Image):
    path = FOLDER / name
    image = kind(array, matrix)
    image.header.set_xyzt_units("mm")
    nibabel.save(image, str(path))
    return path


XYZ = HU.transpose(2, 1, 0)
nifti_case("nifti_plain", "NIfTI-1, .nii", nifti_file("a.nii", XYZ, RAS), "nibabel")
nifti_case("nifti_gzip", "NIfTI-1, .nii.gz", nifti_file("a.nii.gz", XYZ, RAS), "nibabel")
nifti_case("nifti_two", "NIfTI-2", nifti_file("two.nii", XYZ, RAS, nibabel.Nifti2Image), "nibabel", sitk_too=False)
nifti_case("nifti_pair", ".hdr and .img", nifti_file("pair.hdr", XYZ, RAS, nibabel.Nifti1Pair), "nibabel")
nifti_case("nifti_float", "32-bit floats", nifti_file("f.nii", XYZ.astype(np.float32), RAS), "nibabel")
nifti_case("nifti_one_time", "4D with one time", nifti_file("t.nii", XYZ[..., None], RAS), "nibabel")
path = FOLDER / "b.nii.gz"
path.write_bytes((FOLDER / "a.nii.gz").read_bytes() + bytes(512))
nifti_case("nifti_padded", ".nii.gz, zero padding behind it", path, "nibabel, 512 zeros more")
# dcm2niix of a series whose cosines have four decimals: axes off by 1e-5 to 1e-4.
row = np.array([0.9141, 0.393, -0.0998])
column = np.array([-0.3688, 0.9082, 0.1977])
row, column = row / np.linalg.norm(row), column / np.linalg.norm(column)
matrix = np.eye(4)
matrix[:3, 0], matrix[:3, 1] = -row * 0.7, -column * 0.8
matrix[:3, 2] = np.cross(row, column) * 1.5
matrix[:3, :2] *= 1
matrix[:3, 3] = [10, -20, 30]
nifti_case("nifti_cosines", "axes of four decimals", nifti_file("cosines.nii", XYZ, matrix), "nibabel")
path = nifti_file("labels.nii.gz", LABELS.transpose(2, 1, 0), RAS)
case("nifti_label", path, "NIfTI", "labels, `label = 3`", "nibabel", {
    "nibabel": only(by_nibabel(path), 3), "SimpleITK (NIfTI)": only(by_sitk(path), 3)}, {"label": 3})

(FOLDER / "cases.json").write_text(json.dumps(CASES, indent=1))
print(len(CASES), "cases")
