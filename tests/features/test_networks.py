"""Keypoints by networks: where they lie, which of them are taken, and whose weights they are."""

import cv2
import numpy as np
import pytest
import torch
from kornia.feature import ALIKED, DISK
from torch import nn

from torchrefrac.features import Detected, NetworkOptions, WeightsError, extract_by_network, extract_features
from torchrefrac.features.networks import MARGIN, by_aliked, by_disk, downloaded

CENTERS = torch.tensor([[40.5, 40.5], [100.5, 60.5], [61.5, 110.5], [130.5, 130.5]], dtype=torch.float64)


class Brightness(nn.Module):
    """What is bright scores high; descriptors are colours."""

    def forward(self, images):
        blurred = nn.functional.avg_pool2d(images, 3, stride=1, padding=1)
        return torch.cat((blurred, blurred.mean(dim=1, keepdim=True) - 0.1), dim=1)


class BrightAliked(ALIKED):
    """Its backbone is replaced by brightness."""

    def extract_dense_map(self, image):
        features = torch.nn.functional.normalize(image.repeat(1, 22, 1, 1)[:, :64] + 1e-3, dim=1)
        return features, image.mean(dim=1, keepdim=True)


DETECTORS = {
    "disk": lambda: by_disk(DISK(desc_dim=3, unet=Brightness()).eval()),
    "aliked": lambda: by_aliked(BrightAliked("aliked-t16").eval()),
}


def _blobs(centers, width=170, height=150):
    x, y = torch.arange(width) + 0.5, torch.arange(height) + 0.5
    across, down = ((-0.5 * ((axis - centers[:, i, None]) / 2.0) ** 2).exp() for i, axis in enumerate((x, y)))
    return (250.0 * torch.einsum("nx,ny->yx", across, down)).round().byte().numpy()


@pytest.fixture
def write_image(tmp_path):
    def write(image):
        assert cv2.imwrite(str(tmp_path / "image.png"), image)
        return tmp_path / "image.png"

    return write


def _errors(pixels, centers):
    return torch.cdist(centers, pixels).amin(dim=1)


@pytest.mark.parametrize("name", DETECTORS)
def test_a_keypoint_lies_on_its_blob_by_the_convention_of_pixels(name, write_image):
    found = extract_by_network(write_image(_blobs(CENTERS)), DETECTORS[name]())

    assert float(_errors(found.pixels, CENTERS).max()) < 0.05
    assert torch.allclose(found.descriptors.norm(dim=1), torch.ones(len(found)))


@pytest.mark.parametrize("name", DETECTORS)
def test_keypoints_move_with_the_image(name, write_image):
    shift = torch.tensor([7.0, 3.0], dtype=torch.float64)
    network = DETECTORS[name]()

    before = extract_by_network(write_image(_blobs(CENTERS)), network, max_features=4)
    after = extract_by_network(write_image(_blobs(CENTERS + shift)), network, max_features=4)

    assert float(_errors(after.pixels, before.pixels + shift).max()) < 0.02


def test_keypoints_of_a_reduced_image_lie_in_the_whole_one(write_image):
    centers = torch.tensor([[199.5, 160.5], [319.5, 241.5]], dtype=torch.float64)
    x, y = torch.arange(480) + 0.5, torch.arange(360) + 0.5
    across, down = ((-0.5 * ((axis - centers[:, i, None]) / 9.0) ** 2).exp() for i, axis in enumerate((x, y)))
    path = write_image((250.0 * torch.einsum("nx,ny->yx", across, down)).round().byte().numpy())

    found = extract_by_network(path, DETECTORS["aliked"](), max_pixels=480 * 360 / 9.0, max_features=2)

    assert float(_errors(found.pixels, centers).max()) < 0.1
    assert found.noise.tolist() == pytest.approx([3.0, 3.0])


def test_no_keypoint_is_near_what_may_not_be_used(write_image):
    used = torch.ones(150, 170, dtype=torch.bool)
    used[:, :50] = False

    found = extract_by_network(write_image(_blobs(CENTERS)), DETECTORS["disk"](), used)

    assert float(found.pixels[:, 0].min()) > 50.0 + MARGIN - 1.0
    assert float(_errors(found.pixels, CENTERS[[1, 2, 3]])[0]) < 0.05


def test_of_more_keypoints_the_best_are_taken_first(write_image):
    def four(image):
        return Detected(torch.arange(8.0).reshape(4, 2), torch.eye(4), torch.tensor([0.1, 0.4, 0.2, 0.3]))

    found = extract_by_network(write_image(np.zeros((20, 20), dtype=np.uint8)), four, max_features=2)

    assert found.pixels.tolist() == [[2.0, 3.0], [6.0, 7.0]]


@pytest.mark.parametrize(
    ("method", "model"),
    [("kornia_disk", DISK), ("kornia_aliked", lambda: ALIKED("aliked-t16")), ("kornia_aliked", ALIKED)],
)
def test_weights_come_from_a_file(method, model, tmp_path, write_image, draw):
    torch.manual_seed(1)
    network = model().eval()
    torch.save(network.state_dict(), tmp_path / "weights.pth")
    path = write_image(draw.uniform(0.0, 255.0, 70, 90, 3).byte().numpy())
    options = NetworkOptions(method, str(tmp_path / "weights.pth"), max_features=50)

    found = extract_features(path, options, device="cpu")

    adapted = (by_disk if method == "kornia_disk" else by_aliked)(network)
    wanted = extract_by_network(path, adapted, max_features=50)
    assert 0 < len(found) <= 50
    assert torch.equal(found.pixels, wanted.pixels)
    assert torch.equal(found.descriptors, wanted.descriptors)


def test_weights_of_another_network_are_refused(tmp_path, write_image):
    path = write_image(np.zeros((20, 20), dtype=np.uint8))
    torch.save(Brightness().state_dict() | {"a": torch.zeros(1)}, tmp_path / "other.pth")
    (tmp_path / "garbage.pth").write_bytes(b"not weights")
    torch.save(torch.zeros(3), tmp_path / "tensor.pth")

    for name, sentence in (("other", "another network than DISK"), ("garbage", "cannot be read"), ("tensor", "Tensor")):
        with pytest.raises(WeightsError, match=rf"{name}\.pth .*{sentence}"):
            extract_features(path, NetworkOptions(weights=str(tmp_path / f"{name}.pth")), device="cpu")


def test_what_cannot_be_downloaded_says_what_to_do():
    def unreachable():
        raise RuntimeError("Failed to load. Last error: no such host.\nmore")

    with pytest.raises(
        WeightsError, match=r"DISK cannot be downloaded by kornia \(no such host\): name a file .*weigh"
    ):
        downloaded("DISK", "features.weights", unreachable)


def test_options_know_what_is_in_the_file_of_weights(tmp_path):
    path = tmp_path / "weights.pth"
    path.write_bytes(b"one")
    before = NetworkOptions(weights=str(path)).made_from
    path.write_bytes(b"two")

    assert NetworkOptions(weights=str(path)).made_from != before
    assert NetworkOptions().made_from == ()
    with pytest.raises(ValueError, match=r"weights is 'nowhere\.pth', but must be a file"):
        NetworkOptions(weights="nowhere.pth")
