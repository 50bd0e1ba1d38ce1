"""The network: the plain detector's boxes bit for bit, covariances that hold against sampling and derivatives."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.autograd.functional import jacobian
from torchvision.models.detection._utils import BoxCoder

from calibslam_detector.model.box_covariance import (
    corner_covariances,
    coupling_matrix,
    decoder_jacobian,
    decoupled,
    rescaled,
)
from calibslam_detector.model.covariance_head import MAX_COUPLING, VARIANCE_BOUNDS, CovarianceHead
from calibslam_detector.model.familiarity import Familiarity, descriptor
from calibslam_detector.model.network import ARCHITECTURES, CalibratedDetector, freeze_norms
from calibslam_detector.model.region_cues import CUES

CODER = BoxCoder((10.0, 10.0, 5.0, 5.0))
CLASSES = ("cup", "book", "chair")


@pytest.fixture(scope="module")
def images() -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(2)
    return [torch.rand((3, 120, 160), generator=generator), torch.rand((3, 100, 130), generator=generator)]


@pytest.fixture(scope="module")
def network(images: list[torch.Tensor]) -> CalibratedDetector:
    """Random weights, but logits of mean 0 and spread 2: many boxes of all classes."""
    torch.manual_seed(1)
    model = CalibratedDetector("compact", CLASSES).eval()
    predictor = model.detector.roi_heads.box_predictor
    logits = []
    with torch.no_grad():
        hook = predictor.cls_score.register_forward_hook(lambda module, inputs, output: logits.append(output))
        model.detector(images)
        hook.remove()
        scale = 2.0 / logits[0].std(dim=0)
        predictor.cls_score.weight *= scale[:, None]
        predictor.cls_score.bias.copy_((predictor.cls_score.bias - logits[0].mean(dim=0)) * scale)
        model.covariance_head.output.weight.normal_(0.0, 0.3)
    return model


boxes = st.tuples(st.floats(0, 300), st.floats(0, 300), st.floats(5, 200), st.floats(5, 200)).map(
    lambda b: [b[0], b[1], b[0] + b[2], b[1] + b[3]]
)


@settings(max_examples=30)
@given(boxes, st.lists(st.floats(-3.0, 3.0), min_size=4, max_size=4))
def test_the_jacobian_is_that_of_torchvisions_coder(box: list[float], deltas: list[float]) -> None:
    proposal = torch.tensor([box], dtype=torch.float64)
    at = torch.tensor([deltas], dtype=torch.float64)
    numerical = jacobian(lambda d: CODER.decode_single(d, proposal)[0], at)[:, 0]
    analytic = decoder_jacobian(proposal, CODER.decode_single(at, proposal), CODER.weights)[0]
    torch.testing.assert_close(analytic, numerical)


def test_covariances_of_corners_are_those_of_samples() -> None:
    rng = np.random.default_rng(3)
    proposal = torch.tensor([[100.0, 50.0, 180.0, 170.0]], dtype=torch.float64)
    mean = np.array([0.5, -0.3, 0.4, -0.2])
    variances, couplings = np.array([0.01, 0.02, 0.005, 0.01]), np.array([0.6, -0.8])
    L = np.eye(4)
    L[2, 0], L[3, 1] = couplings
    samples = mean + rng.standard_normal((200_000, 4)) * np.sqrt(variances) @ L.T
    corners = CODER.decode_single(torch.tensor(samples), proposal.expand(len(samples), 4)).numpy()
    box = CODER.decode_single(torch.tensor(mean[None]), proposal)
    expected = corner_covariances(
        torch.tensor(variances[None]), torch.tensor(couplings[None]), proposal, box, CODER.weights
    )[0].numpy()
    # Within the curvature of exp (sigma of log width: 2 %) and the samples' own spread.
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(np.cov(corners.T) / scale, expected / scale, atol=0.02)


def test_decoupled_residuals_have_a_diagonal_covariance() -> None:
    couplings = torch.tensor([[0.7, -0.4]], dtype=torch.float64)
    residuals = torch.tensor([[1.0, 2.0, 3.0, 4.0]], dtype=torch.float64)
    L = coupling_matrix(couplings)[0]
    torch.testing.assert_close(decoupled(residuals, couplings)[0], torch.linalg.solve(L, residuals[0]))
    assert decoupled(residuals, couplings)[0].tolist() == pytest.approx([1.0, 2.0, 2.3, 4.8])


def test_one_sure_edge_can_be_said() -> None:
    """With coupling -1 and no other error of the width, xmin's error is nothing and xmax's is all."""
    proposal = torch.tensor([[0.0, 0.0, 100.0, 100.0]])
    variances = torch.tensor([[0.25, 0.25, 1e-6, 1e-6]])
    covariance = corner_covariances(variances, torch.tensor([[1.0, -1.0]]), proposal, proposal, CODER.weights)[0]
    # sigma(d_x) = 0.5: the centre errs by 5 px, so one edge by 10 and the other not at all.
    torch.testing.assert_close(covariance.diagonal(), torch.tensor([0.0, 100.0, 100.0, 0.0]), atol=1e-3, rtol=0)


def test_an_image_of_another_size_scales_each_axis() -> None:
    scaled = rescaled(torch.ones((1, 4, 4)), (100, 200), (200, 600))[0]
    np.testing.assert_allclose(scaled[0], [9.0, 6.0, 9.0, 6.0])
    np.testing.assert_allclose(scaled[1], [6.0, 4.0, 6.0, 4.0])


def test_boxes_are_the_plain_detectors_bit_for_bit(network: CalibratedDetector, images: list[torch.Tensor]) -> None:
    with torch.no_grad():
        plain, ours = network.detector(images), network.detect(images)
    assert sum(len(result["boxes"]) for result in plain) > 20
    assert len({int(label) for result in plain for label in result["labels"]}) > 1
    for expected, result in zip(plain, ours, strict=True):
        for key in ("boxes", "labels", "scores"):
            assert torch.equal(result[key], expected[key]), key
        assert result["covariances"].shape == (len(result["boxes"]), 4, 4)
        eigenvalues = torch.linalg.eigvalsh(result["covariances"].double())
        assert (eigenvalues > 0.0).all()


def test_the_covariance_is_that_of_the_chosen_class_and_region(
    network: CalibratedDetector, images: list[torch.Tensor]
) -> None:
    """Recomputed for one box at a time, from its own features."""
    with torch.no_grad():
        found, results = network.regions(images), network.detect(images)
        for image, regions, result in zip(images, found, results, strict=True):
            variances, couplings = network.covariance_head(regions.features, regions.cues, regions.labels)
            assert variances.std() > 0.0
            k = len(regions.labels) // 2
            J = decoder_jacobian(regions.proposals[k : k + 1], regions.boxes[k : k + 1], CODER.weights)[0]
            L = coupling_matrix(couplings[k : k + 1])[0]
            y, x = image.shape[-2] / regions.size[0], image.shape[-1] / regions.size[1]
            scale = torch.tensor([x, y, x, y])
            expected = J @ L @ torch.diag(variances[k]) @ L.T @ J.T * scale[:, None] * scale
            torch.testing.assert_close(result["covariances"][k], expected, rtol=1e-4, atol=1e-4)


def test_the_head_stays_within_its_bounds_and_begins_alike_for_all() -> None:
    head = CovarianceHead(8, 4).eval()
    features, labels = 100.0 * torch.randn(50, 8), torch.randint(0, 4, (50,))
    variances, couplings = head(features, torch.zeros(50, CUES), labels)
    torch.testing.assert_close(variances, torch.full((50, 4), float(np.sqrt(np.prod(VARIANCE_BOUNDS)))))
    assert (couplings == 0.0).all()
    torch.nn.init.normal_(head.output.weight, 0.0, 100.0)
    variances, couplings = head(features, torch.zeros(50, CUES), labels)
    assert (variances >= VARIANCE_BOUNDS[0] * 0.999).all() and (variances <= VARIANCE_BOUNDS[1] * 1.001).all()
    assert (couplings.abs() <= MAX_COUPLING).all()


def test_what_is_said_of_a_box_does_not_depend_on_the_threshold(
    network: CalibratedDetector, images: list[torch.Tensor]
) -> None:
    """A box that hides another one may itself be below the threshold."""
    heads = network.detector.roi_heads
    threshold = heads.score_thresh
    with torch.no_grad():
        every = network.regions(images[:1])[0]
        try:
            heads.score_thresh = float(every.scores.median())
            some = network.regions(images[:1])[0]
        finally:
            heads.score_thresh = threshold
    n = len(some.boxes)
    assert 0 < n < len(every.boxes)
    for name in ("boxes", "labels", "scores", "features"):
        assert torch.equal(getattr(some, name), getattr(every, name)[:n]), name
    torch.testing.assert_close(some.cues, every.cues[:n], rtol=1e-4, atol=1e-4)


def test_images_unlike_those_known_are_strange() -> None:
    generator = torch.Generator().manual_seed(5)
    mixing = torch.randn(16, 16, generator=generator)
    known, like, unlike = (torch.randn(n, 16, generator=generator) @ mixing for n in (4000, 4000, 1000))
    familiarity = Familiarity(16)
    assert (familiarity(known) == 0.0).all()
    familiarity.fit(known)
    # 95 % of 4000, with the spread of the quantile of 1000 held-out ones (0.7 points).
    assert float((familiarity(like) > 1.0).float().mean()) == pytest.approx(0.05, abs=0.022)
    assert float((familiarity(unlike + 3.0 * mixing.sum(dim=0)) > 1.0).float().mean()) > 0.9
    torch.testing.assert_close(descriptor(torch.arange(8.0).view(1, 2, 2, 2)), torch.tensor([[1.5, 5.5]]))


def test_no_box_is_no_trouble(network: CalibratedDetector, images: list[torch.Tensor]) -> None:
    threshold = network.detector.roi_heads.score_thresh
    network.detector.roi_heads.score_thresh = 2.0
    try:
        with torch.no_grad():
            (result,) = network.detect(images[:1])
    finally:
        network.detector.roi_heads.score_thresh = threshold
    assert result["boxes"].shape == (0, 4) and result["covariances"].shape == (0, 4, 4)


def test_regions_need_evaluation_mode(images: list[torch.Tensor]) -> None:
    with pytest.raises(RuntimeError, match="evaluation mode"):
        CalibratedDetector("compact", CLASSES).train().regions(images)


def test_frozen_norms_compute_what_batch_norms_do() -> None:
    plain = torch.nn.Sequential(torch.nn.Conv2d(3, 4, 3), torch.nn.Sequential(torch.nn.BatchNorm2d(4)))
    plain(torch.rand(5, 3, 8, 8))
    plain.eval()
    image = torch.rand(1, 3, 8, 8)
    expected = plain(image)
    freeze_norms(plain)
    assert not any(isinstance(module, torch.nn.BatchNorm2d) for module in plain.modules())
    torch.testing.assert_close(plain(image), expected)


def test_every_architecture_has_its_size() -> None:
    """In millions of weights; the compact one fits into 25 MB at half precision."""
    sizes = {}
    for name in ARCHITECTURES:
        with torch.device("meta"):
            sizes[name] = sum(p.numel() for p in CalibratedDetector(name, CLASSES).parameters()) / 1e6
    assert sizes["compact"] < 9.0
    assert sizes["compact"] < sizes["mobilenet_v3_large_320_fpn"] < sizes["resnet50_fpn_v2"] < sizes["resnet101_fpn"]
