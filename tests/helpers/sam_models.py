"""SAM 2 and the tracker of SAM 3, tiny and with random weights, as folders that the real loading code reads."""

from tableverse_factory.evaluation.bench.sam_random import SIZES

TINY_SAM3 = {
    "vision_config": {
        "model_type": "sam3_vision_model",
        "backbone_config": {
            "model_type": "sam3_vit_model",
            "hidden_size": 32,
            "intermediate_size": 64,
            "num_hidden_layers": 2,
            "num_attention_heads": 2,
            "image_size": 112,
            "patch_size": 14,
            "pretrain_image_size": 112,
            "window_size": 4,
            "global_attn_indexes": [1],
        },
        "fpn_hidden_size": 32,
        "backbone_feature_sizes": [[32, 32], [16, 16], [8, 8]],
    },
    "prompt_encoder_config": {"hidden_size": 32, "image_size": 112, "patch_size": 14},
    "mask_decoder_config": {"hidden_size": 32, "mlp_dim": 32, "num_attention_heads": 2, "iou_head_hidden_dim": 16},
}


def save_tiny(name, folder, seed=0):
    """A model of the family `sam2` or `sam3` in a folder; its decoder speaks up, so that masks are no faint noise."""
    import torch
    import transformers

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        if name == "sam2":
            model = transformers.Sam2Model(transformers.Sam2Config(**SIZES["tiny"]))
        else:
            model = transformers.Sam3TrackerModel(transformers.Sam3TrackerConfig(**TINY_SAM3))
        with torch.no_grad():
            for weight in model.mask_decoder.parameters():
                weight.mul_(8.0)
    model.save_pretrained(folder)
    return model
