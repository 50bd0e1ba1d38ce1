"""Faster R-CNN (Ren et al., 2015) as torchvision has it, with a covariance head beside the box head.

The boxes are those of the plain detector, bit for bit: the head sees what the detector has chosen and changes
nothing of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torchvision.models.detection import (
    FasterRCNN,
    fasterrcnn_mobilenet_v3_large_320_fpn,
    fasterrcnn_resnet50_fpn_v2,
)
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.models.detection.backbone_utils import BackboneWithFPN, resnet_fpn_backbone
from torchvision.models.detection.faster_rcnn import FastRCNNPredictor, TwoMLPHead
from torchvision.models.mobilenetv3 import mobilenet_v3_large
from torchvision.ops import batched_nms, clip_boxes_to_image, remove_small_boxes
from torchvision.ops.misc import FrozenBatchNorm2d

from calibslam_detector.images.coco_data import BOX_KEYS
from calibslam_detector.model.box_covariance import corner_covariances, rescaled
from calibslam_detector.model.covariance_head import CovarianceHead
from calibslam_detector.model.familiarity import Familiarity, descriptor
from calibslam_detector.model.region_cues import LEAST_NEIGHBOUR, Chosen, agreement, geometry, hiding, second_look

# The compact network: a quarter of torchvision's MobileNet detector, and finer levels for small things.
COMPACT_CHANNELS, COMPACT_FEATURES = 128, 256  # of a level, of a region
COMPACT_STAGES = (4, 7, 16)  # of MobileNet v3 large: strides 8, 16, 32
COMPACT_ANCHORS = ((24,), (48,), (112,), (224,))  # [px of an input 320 high], for these levels and a coarser one
COMPACT_REGIONS = 96  # learnt from per image


def _mobilenet(classes: int) -> FasterRCNN:
    return fasterrcnn_mobilenet_v3_large_320_fpn(weights=None, weights_backbone=None, num_classes=classes)


def _compact(classes: int) -> FasterRCNN:
    stages = mobilenet_v3_large(weights=None, norm_layer=nn.BatchNorm2d).features
    backbone = BackboneWithFPN(
        stages,
        return_layers={str(stage): str(level) for level, stage in enumerate(COMPACT_STAGES)},
        in_channels_list=[stages[stage].out_channels for stage in COMPACT_STAGES],
        out_channels=COMPACT_CHANNELS,
        norm_layer=nn.BatchNorm2d,
    )
    return FasterRCNN(
        backbone,
        min_size=320,
        max_size=640,
        rpn_anchor_generator=AnchorGenerator(COMPACT_ANCHORS, ((0.5, 1.0, 2.0),) * len(COMPACT_ANCHORS)),
        rpn_pre_nms_top_n_train=400,
        rpn_post_nms_top_n_train=200,
        rpn_pre_nms_top_n_test=150,
        rpn_post_nms_top_n_test=100,
        box_head=TwoMLPHead(COMPACT_CHANNELS * 7 * 7, COMPACT_FEATURES),
        box_predictor=FastRCNNPredictor(COMPACT_FEATURES, classes),
        box_batch_size_per_image=COMPACT_REGIONS,
    )


def _resnet50(classes: int) -> FasterRCNN:
    return fasterrcnn_resnet50_fpn_v2(weights=None, weights_backbone=None, num_classes=classes)


def _resnet101(classes: int) -> FasterRCNN:
    backbone = resnet_fpn_backbone(
        backbone_name="resnet101", weights=None, trainable_layers=5, norm_layer=nn.BatchNorm2d
    )
    return FasterRCNN(backbone, classes)


ARCHITECTURES: dict[str, Callable[[int], FasterRCNN]] = {
    "compact": _compact,
    "mobilenet_v3_large_320_fpn": _mobilenet,
    "resnet50_fpn_v2": _resnet50,
    "resnet101_fpn": _resnet101,
}


@dataclass(frozen=True)
class Regions:
    """The regions that a detector chose in one image, N of them, best first.

    Attributes:
        boxes: (N, 4) [px of the network's input], cut at the border.
        scores, labels: (N,).
        proposals: (N, 4) that the boxes were described against [px of the network's input].
        features: (N, F) of the boxes, seen as regions once more.
        cues: (N, CUES), see `region_cues`.
        descriptor: (C,) of the whole image, see `familiarity`.
        size: height and width of the network's input [px].
    """

    boxes: Tensor
    scores: Tensor
    labels: Tensor
    proposals: Tensor
    features: Tensor
    cues: Tensor
    descriptor: Tensor
    size: tuple[int, int]


class CalibratedDetector(nn.Module):
    """A detector whose boxes have covariances, and which knows the images that it has learnt them from.

    `forward` is that of the plain detector, for training it.

    Args:
        architecture: of ARCHITECTURES.
        class_names: without the background; the label of the first is 1.
        frozen_norm: normalise by fixed numbers, as torchvision's COCO weights do, instead of those of a batch.
        boxes: which boxes it learns, of `coco_data.BOX_KEYS`.
    """

    def __init__(
        self, architecture: str, class_names: tuple[str, ...], frozen_norm: bool = False, boxes: str = BOX_KEYS[0]
    ) -> None:
        super().__init__()
        self.architecture, self.class_names, self.frozen_norm = architecture, class_names, frozen_norm
        self.boxes = boxes
        classes = len(class_names) + 1
        self.detector = ARCHITECTURES[architecture](classes)
        if frozen_norm:
            freeze_norms(self.detector)
        self.familiarity = Familiarity(self.detector.backbone.out_channels)
        self.covariance_head = CovarianceHead(self.detector.roi_heads.box_predictor.cls_score.in_features, classes)

    def finds_boxes_as(self, other: CalibratedDetector) -> bool:
        """Whether both find the same boxes, bit for bit, whatever they say of them."""
        if (self.architecture, self.class_names) != (other.architecture, other.class_names):
            return False
        ours, theirs = self.detector.state_dict(), other.detector.state_dict()
        return ours.keys() == theirs.keys() and all(
            torch.equal(w.cpu(), theirs[name].cpu()) for name, w in ours.items()
        )

    def forward(self, images: list[Tensor], targets: list[dict[str, Tensor]] | None = None) -> dict[str, Tensor]:
        """Losses of the plain detector, of images (3, H, W) in [0, 1] and targets as torchvision has them."""
        losses: dict[str, Tensor] = self.detector(images, targets)
        return losses

    def regions(self, images: list[Tensor]) -> list[Regions]:
        """What the plain detector finds in images (3, H, W) in [0, 1], before sizes are put back.

        Raises:
            RuntimeError: the detector is in training mode.
        """
        if self.training:
            raise RuntimeError("regions are found in evaluation mode only")
        inputs, _ = self.detector.transform(images)
        features = self.detector.backbone(inputs.tensors)
        proposals, _ = self.detector.rpn(inputs, features)
        heads = self.detector.roi_heads
        logits, deltas = heads.box_predictor(
            heads.box_head(heads.box_roi_pool(features, proposals, inputs.image_sizes))
        )
        counts = [len(p) for p in proposals]
        boxes = [
            clip_boxes_to_image(b, size)
            for b, size in zip(heads.box_coder.decode(deltas, proposals).split(counts), inputs.image_sizes, strict=True)
        ]
        scores = torch.softmax(logits, -1).split(counts)
        found = [self._find(b, s) for b, s in zip(boxes, scores, strict=True)]
        chosen = [f[f.scores > heads.score_thresh] for f in found]
        looks, seen = self._look_again(features, chosen, inputs.image_sizes)
        return [
            Regions(
                boxes=c.boxes,
                scores=c.scores,
                labels=c.labels,
                proposals=p[c.regions],
                features=vector,
                cues=torch.cat([geometry(c, s, size), agreement(c, b, s, p), hiding(c, f), look], dim=1),
                descriptor=image_descriptor,
                size=(int(size[0]), int(size[1])),
            )
            for c, f, b, s, p, look, vector, image_descriptor, size in zip(
                chosen, found, boxes, scores, proposals, looks, seen, descriptor(features["0"]), inputs.image_sizes,
                strict=True,
            )
        ]  # fmt: skip

    def _find(self, boxes: Tensor, scores: Tensor) -> Chosen:
        """Of all boxes (P, C, 4) and scores (P, C) of an image those that count, as torchvision chooses them; and of
        smaller scores those that may hide them, so that what hides a box does not depend on the threshold.
        """
        heads = self.detector.roi_heads
        classes = scores.shape[1] - 1
        flat_boxes, flat_scores = boxes[:, 1:].reshape(-1, 4), scores[:, 1:].reshape(-1)
        kept = torch.where(flat_scores > min(heads.score_thresh, LEAST_NEIGHBOUR))[0]
        kept = kept[remove_small_boxes(flat_boxes[kept], min_size=1e-2)]
        best = batched_nms(flat_boxes[kept], flat_scores[kept], kept % classes + 1, heads.nms_thresh)
        kept = kept[best[: heads.detections_per_img]]
        of_region = torch.div(kept, classes, rounding_mode="floor")
        return Chosen(flat_boxes[kept], flat_scores[kept], kept % classes + 1, of_region)

    def _look_again(
        self, features: dict[str, Tensor], chosen: list[Chosen], sizes: list[tuple[int, int]]
    ) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        """Of each image the cues (N, SECOND_LOOK) and features (N, F) that the box head has of boxes as proposals."""
        heads = self.detector.roi_heads
        labels = torch.cat([c.labels for c in chosen])
        vectors = heads.box_head(heads.box_roi_pool(features, [c.boxes for c in chosen], sizes))
        logits, deltas = heads.box_predictor(vectors)
        each = torch.arange(len(labels), device=labels.device)
        scores = torch.softmax(logits, -1)
        cues = second_look(
            deltas.view(len(labels), scores.shape[1], 4)[each, labels], scores[each, labels], scores[:, 0]
        )
        counts = [len(c.boxes) for c in chosen]
        return cues.split(counts), vectors.split(counts)

    def covariances(self, regions: Regions) -> Tensor:
        """(N, 4, 4) of the boxes of regions [px^2 of the network's input]."""
        variances, couplings = self.covariance_head(regions.features, regions.cues, regions.labels)
        weights = self.detector.roi_heads.box_coder.weights
        return corner_covariances(variances, couplings, regions.proposals, regions.boxes, weights)

    def detect(self, images: list[Tensor]) -> list[dict[str, Tensor]]:
        """Boxes (N, 4), labels and scores (N,) as torchvision returns them, covariances (N, 4, 4) [px^2], and the
        image's strangeness (), see `familiarity`.
        """
        found = self.regions(images)
        originals = [(int(image.shape[-2]), int(image.shape[-1])) for image in images]
        plain = [{"boxes": r.boxes, "labels": r.labels, "scores": r.scores} for r in found]
        results: list[dict[str, Tensor]] = self.detector.transform.postprocess(
            plain, [r.size for r in found], originals
        )
        for result, regions, original in zip(results, found, originals, strict=True):
            result["strangeness"] = self.familiarity(regions.descriptor[None])[0]
            result["covariances"] = rescaled(self.covariances(regions), regions.size, original)
        return results


def freeze_norms(module: nn.Module) -> None:
    """Replace batch normalisation by one with the same, fixed numbers."""
    for name, child in module.named_children():
        if isinstance(child, nn.BatchNorm2d):
            frozen = FrozenBatchNorm2d(child.num_features, child.eps)
            frozen.load_state_dict(child.state_dict())
            setattr(module, name, frozen)
        else:
            freeze_norms(child)
