"""Depth Anything V2, tiny and with random weights, as a folder that the real loading code reads."""


def save_tiny_depth(folder, kind="metric", seed=0, max_depth=20):
    """The true architecture, saved as its authors' are."""
    import torch
    import transformers

    backbone = transformers.Dinov2Config(
        hidden_size=16, num_attention_heads=2, num_hidden_layers=4, image_size=518, patch_size=14,
        out_indices=[1, 2, 3, 4], reshape_hidden_states=False, apply_layernorm=True,
    )  # fmt: skip
    config = transformers.DepthAnythingConfig(
        backbone_config=backbone, reassemble_hidden_size=16, neck_hidden_sizes=[8, 8, 8, 8], fusion_hidden_size=8,
        head_hidden_size=8, depth_estimation_type=kind, max_depth=max_depth if kind == "metric" else 1,
    )  # fmt: skip
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        transformers.DepthAnythingForDepthEstimation(config).save_pretrained(folder)
