"""The library: uploads, references, and inspection of classifiers without importing torch here."""

import io
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from tests.small_models import triangle_zip
from trompe_server.classifiers.tiny import CLASSES, IMAGE_SIZE
from trompe_server.errors import AmbiguousError, NotFoundError
from trompe_server.library import Library
from trompe_server.library.library import inspect_classifier
from trompe_server.storage.folders import open_folder
from trompe_shared.errors import ClassifierError
from trompe_shared.object3d import encode_png, load_object
from trompe_shared.shipped import shipped_objects


class Net(torch.nn.Module):
    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return images.mean(dim=(2, 3))


def test_an_object_comes_back_byte_for_byte(tmp_path: Path) -> None:
    info = Library(tmp_path).add_object(io.BytesIO(triangle_zip()), "triangle.zip")
    again = Library(tmp_path)
    assert again.objects.find("triangle") == info
    assert again.object_bytes(info.id) == again.object_bytes(info.id[:6]) == triangle_zip()


@pytest.mark.parametrize(
    ("name", "filename", "expected"),
    [
        pytest.param("mug v1.2", "a.zip", "mug v1.2", id="a dot in a given name"),
        pytest.param(None, "mug v1.2.zip", "mug v1.2", id="a dot in the name of a file"),
        pytest.param(None, "a\0\n.zip", "a__", id="control characters"),
        pytest.param(None, "\udce9t\ud800.zip", "_t_", id="bytes that are not UTF-8"),
        pytest.param("\udce9", "a.zip", "_", id="bytes that are not UTF-8 in a given name"),
    ],
)
def test_an_object_has_the_given_name_or_the_stem_of_its_file(
    tmp_path: Path, name: str | None, filename: str, expected: str
) -> None:
    info = Library(tmp_path).add_object(io.BytesIO(triangle_zip()), filename, name=name)
    assert info.name == expected
    assert Library(tmp_path).objects.find(expected) == info


@pytest.mark.parametrize("damaged", ["info.json", "data.zip"])
def test_a_damaged_upload_is_left_out_or_repaired_by_the_same_file(tmp_path: Path, damaged: str) -> None:
    library = Library(tmp_path)
    kept = library.add_background(encode_png(np.zeros((4, 4, 3), np.uint8)), "kept.png")
    info = library.add_object(io.BytesIO(triangle_zip()), "triangle.zip")
    file = tmp_path / "objects" / info.id / damaged
    file.write_bytes(file.read_bytes()[:20])
    assert (info in library.objects.all()) == (damaged == "data.zip")
    assert library.backgrounds.all() == [kept]
    assert Library(tmp_path).add_object(io.BytesIO(triangle_zip()), "triangle.zip") == info
    assert library.object_bytes("triangle") == triangle_zip()


def test_a_refused_classifier_is_called_by_its_own_name(tmp_path: Path) -> None:
    library = Library(tmp_path, inspect=Mock(side_effect=ClassifierError("'data.pt2': its output is a tuple.")))
    with pytest.raises(ClassifierError, match=r"'mine v2\.pt2': its output is a tuple"):
        library.add_classifier(io.BytesIO(b"?"), "mine v2.pt2")


@pytest.mark.parametrize("filename", ["photo.été", "photo." + "x" * 300, "photo", "photo.\udce9"])
def test_a_background_is_stored_under_any_file_name(tmp_path: Path, filename: str) -> None:
    data = encode_png(np.zeros((4, 4, 3), np.uint8))
    info = Library(tmp_path).add_background(data, filename)
    assert Library(tmp_path).background_bytes("photo") == data
    file = tmp_path / "backgrounds" / info.id / "data"
    file.rename(file.with_suffix(".png"))  # as earlier versions stored it
    assert Library(tmp_path).background_bytes("photo") == data


def test_the_same_upload_from_many_sides_at_once_is_stored_once(tmp_path: Path) -> None:
    library = Library(tmp_path)
    with ThreadPoolExecutor(8) as pool:
        infos = list(pool.map(lambda _: library.add_object(io.BytesIO(triangle_zip()), "triangle.zip"), range(16)))
    assert len({info.id for info in infos}) == 1
    assert len(list(tmp_path.rglob("data.zip"))) == 1
    assert list(tmp_path.rglob(".*")) == []


def test_short_beginnings_of_ids_are_not_taken(tmp_path: Path) -> None:
    info = Library(tmp_path).add_object(io.BytesIO(triangle_zip()), "triangle.zip")
    with pytest.raises(NotFoundError, match="triangle"):
        Library(tmp_path).objects.find(info.id[:5])


def test_a_beginning_that_fits_two_ids_is_refused(tmp_path: Path) -> None:
    library = Library(tmp_path)
    info = library.add_object(io.BytesIO(triangle_zip()), "one.zip")
    for identity in ("abcdef1", "abcdef2"):
        stored = info.model_copy(update={"id": identity, "name": identity}).model_dump_json()
        open_folder(tmp_path).within("objects").within(identity).write("info.json", stored.encode())
    with pytest.raises(AmbiguousError, match="abcdef1, abcdef2"):
        library.objects.find("abcdef")


def test_shipped_objects_are_there_from_the_start(tmp_path: Path) -> None:
    infos = {info.name: info for info in Library(tmp_path).objects.all()}
    assert list(infos) == list(shipped_objects())
    assert all(info.shipped for info in infos.values())
    assert load_object(Library(tmp_path).object_bytes("mug")).n_texels > 0


def test_a_classifier_file_is_described_by_a_process_of_its_own_once(tmp_path: Path) -> None:
    file = tmp_path / "net.pt2"
    batch = ({0: torch.export.Dim.DYNAMIC},)
    torch.export.save(torch.export.export(Net(), (torch.zeros(2, 3, 8, 12),), dynamic_shapes=batch), file)
    data, inspect = file.read_bytes(), Mock(side_effect=inspect_classifier)
    library = Library(tmp_path / "library", inspect=inspect)
    info = library.add_classifier(io.BytesIO(data), "net.pt2", classes=["r", "g", "b"], name="colours")
    assert (info.name, info.white_box, info.image_size, info.n_classes) == ("colours", True, (8, 12), 3)
    assert info.classes == ["r", "g", "b"]
    assert Path(library.classifier_path("colours")).read_bytes() == data
    again = library.add_classifier(io.BytesIO(data), "net.pt2")
    assert again == info.model_copy(update={"name": "net"})
    assert inspect.call_count == 1
    with pytest.raises(ClassifierError, match=r"'net.onnx' is stored already, as a \.pt2 file"):
        library.add_classifier(io.BytesIO(data), "net.onnx")
    assert library.classifier_path("net") == library.classifier_path(info.id)
    with pytest.raises(ClassifierError, match=r"2 class names for .* of 3.*net.classes.json"):
        library.add_classifier(io.BytesIO(data), "net.pt2", classes=["r", "g"])


def test_the_shipped_classifier_is_described_as_it_is(tmp_path: Path) -> None:
    library = Library(tmp_path)
    info = library.classifier("tiny")
    assert library.classifier_path("tiny") == "tiny"
    assert info.classes == list(CLASSES)
    assert (info.n_classes, info.image_size, info.white_box) == (len(CLASSES), IMAGE_SIZE, True)


def test_the_api_process_never_imports_torch_and_alembic_only_to_migrate() -> None:
    modules = ", ".join(f"trompe_server.service.{name}" for name in ("app", "serve", "commands"))
    script = f"import sys, {modules}; print('torch' in sys.modules, 'alembic' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False False"


def test_jobs_name_networks_of_the_operators_list_only(tmp_path: Path) -> None:
    inspect = Mock(return_value={"white_box": True, "image_size": [8, 8], "n_classes": 2, "classes": None})
    library = Library(tmp_path, inspect=inspect, networks=("timm:vit_*", "torchvision:resnet50"))
    for reference in ("timm:vit_tiny", "torchvision:resnet50", "timm:vit_tiny"):
        assert library.classifier(reference).id == reference
    assert [call.args for call in inspect.call_args_list] == [("timm:vit_tiny",), ("torchvision:resnet50",)]
    assert library.classifier_path("timm:vit_tiny") == "timm:vit_tiny"
    for refused in ("timm:resnet50", "hf:org/model", "torchvision:resnet50x"):
        with pytest.raises(ClassifierError, match=rf"does not allow the network '{refused}'; it allows timm:vit_\*, "):
            library.classifier(refused)
    with pytest.raises(ClassifierError, match="it allows none"):
        Library(tmp_path).classifier("timm:vit_tiny")
