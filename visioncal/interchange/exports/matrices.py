"""A transform as a 4x4 matrix: plain text, OpenCV's storage, Zivid's file."""

import cv2

from visioncal.core.files import one_line
from visioncal.core.types import FloatArray
from visioncal.interchange.exports.content import Content, ExportFormat, comments, rows, yaml_text
from visioncal.interchange.exports.lens import warn_of_field
from visioncal.vision.camera import matrix_3x3


def _write_text(content: Content) -> str:
    lines = [" ".join(map(repr, row)) for row in rows(content.matrix)]
    notes = comments("#", content.notes)
    return notes + "\n".join(lines) + "\n"


def _write_opencv(content: Content) -> str:
    """Writes OpenCV's FileStorage, by OpenCV itself."""
    # The lens has the names of OpenCV's own calibration (samples/cpp/calibration.cpp).
    storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for line in filter(None, (*content.notes, content.field_error_words)):
        storage.writeComment(one_line(line), append=False)
    storage.write("parent", content.parent)
    storage.write("child", content.child)
    storage.write("transform", content.matrix)
    storage.write("R", content.matrix[:3, :3].copy())
    storage.write("t", content.matrix[:3, 3:].copy())
    if content.refitted_lens is not None:
        camera = content.refitted_lens.camera
        storage.write("image_width", camera.resolution[0])
        storage.write("image_height", camera.resolution[1])
        storage.write("distortion_model", camera.model)
        storage.write("camera_matrix", matrix_3x3(camera))
        storage.write("distortion_coefficients", camera.distortion.reshape(1, -1).copy())
    return storage.releaseAndGetString()


def _write_zivid(content: Content) -> str:
    """Writes the file that Matrix4x4 of Zivid's SDK loads, in millimetres."""
    # Fields as in zivid-python, Matrix4x4.save, and zivid-python-samples, save_load_matrix.py.
    # Without a comment, as the SDK's own parser is not public.
    matrix_mm: FloatArray = content.matrix.copy()
    matrix_mm[:3, 3] *= 1e3
    version = yaml_text({"__version__": {"serializer": 1, "data": 1}})
    return version + yaml_text({"FloatMatrix": {"Data": rows(matrix_mm)}}, short_lists=True)


MATRICES = (
    ExportFormat(
        "opencv",
        "OpenCV's FileStorage: transform, R, t and any lens [m]",
        _write_opencv,
        warn=warn_of_field,
        carries_lens=True,
    ),
    ExportFormat("zivid", "a Matrix4x4 of Zivid's SDK as YAML [mm]", _write_zivid),
    ExportFormat(
        "text",
        "the 4x4 matrix as text, as numpy.loadtxt reads it [m]",
        _write_text,
        write_all=lambda contents: "".join(map(_write_text, contents)),
    ),
)
