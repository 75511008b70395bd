"""SAM 2 with random weights, at its published size or tiny: as fast as the real one, and as blind as a newborn."""

from typing import Any

from tableverse_factory.models.local.device import Device, torch_here
from tableverse_factory.models.local.weights import on_device
from tableverse_factory.stages.perceive.sam.model import EXACT, FAMILIES, Sam

SIZES: dict[str, dict[str, Any]] = {
    "large": {
        "vision_config": {
            "model_type": "sam2_vision_model",
            "backbone_config": {
                "model_type": "sam2_hiera_det_model",
                "hidden_size": 144,
                "num_attention_heads": 2,
                "blocks_per_stage": [2, 6, 36, 4],
                "embed_dim_per_stage": [144, 288, 576, 1152],
                "num_attention_heads_per_stage": [2, 4, 8, 16],
                "window_size_per_stage": [8, 4, 16, 8],
                "global_attention_blocks": [23, 33, 43],
                "window_positional_embedding_background_size": [7, 7],
            },
            "backbone_channel_list": [1152, 576, 288, 144],
        },
    },
    "tiny": {
        "vision_config": {
            "model_type": "sam2_vision_model",
            "backbone_config": {
                "model_type": "sam2_hiera_det_model",
                "hidden_size": 8,
                "image_size": [128, 128],
                "blocks_per_stage": [1, 1, 2, 1],
                "embed_dim_per_stage": [8, 16, 32, 64],
                "num_attention_heads_per_stage": [1, 1, 2, 2],
                "window_size_per_stage": [8, 4, 8, 4],
                "global_attention_blocks": [3],
                "window_positional_embedding_background_size": [2, 2],
            },
            "backbone_channel_list": [64, 32, 16, 8],
            "backbone_feature_sizes": [[32, 32], [16, 16], [8, 8]],
            "fpn_hidden_size": 32,
        },
        "prompt_encoder_config": {"hidden_size": 32, "image_size": 128},
        "mask_decoder_config": {"hidden_size": 32, "mlp_dim": 32, "num_attention_heads": 2, "iou_head_hidden_dim": 16},
    },
}


def random_sam2(size: str, device: Device, seed: int = 0) -> Sam:
    """The model of this size on the device; equal seeds, equal weights."""
    import transformers

    with torch_here().random.fork_rng(devices=[]):
        torch_here().manual_seed(seed)
        model = transformers.Sam2Model(transformers.Sam2Config(**SIZES[size]))
    return Sam(on_device(model, device, EXACT), FAMILIES["sam2"].normal, device)
