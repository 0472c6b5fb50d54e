"""Masks as segmenters write them (SAM, SAM 2, DAVIS, COCO): one reader for each form, chosen by ``masks.kind``.

Plain ``masks`` (a pattern, or a list) are images that are black and white. An object says more::

    {"frames": "seg/*.png", "kind": "labels", "ids": [1, 4]}   numbers of instances; the others are background
    {"file": "masks.npy", "kind": "stack"}                     one array (T,H,W), or (T,N,H,W) of N instances
    {"frames": "sam/*.json", "kind": "coco"}                   run lengths, a file a frame (SA-1B)
    {"file": "masks.json", "kind": "coco"}                     run lengths of a whole video (COCO, YouTube-VIS)

forms.py        black and white, label images, stacks of arrays; which reader takes a file
run_lengths.py  COCO's run lengths
"""

from .forms import MASKS, MaskReader, read_masks

__all__ = ["MASKS", "MaskReader", "read_masks"]
