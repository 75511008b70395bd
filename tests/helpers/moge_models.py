"""MoGe-2 with random weights, as a folder that its own package reads; thin, but for the encoder."""

WIDTHS = [16, 8, 8, 8, 8]


def save_thin_moge(folder, seed=0):
    """The true architecture, as its authors' `configs/train/v2.json` describes it; most pixels are valid."""
    import torch
    from moge.model.v2 import MoGeModel

    config = {
        "encoder": {"backbone": "dinov2_vits14", "intermediate_layers": [5, 11], "dim_out": 16},
        "neck": _make_stack([18, 2, 2, 2, 2], None, [0, 2, 2, 2, 0]),
        **{f"{name}_head": _make_head(size) for name, size in (("points", 3), ("normal", 3), ("mask", 1))},
        "scale_head": {"dims": [384, 16, 1]},
        "remap_output": "exp",
        "num_tokens_range": [40, 80],
    }
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        weights = MoGeModel(**config).state_dict()
    weights["mask_head.output_blocks.4.bias"] += 3.0
    torch.save({"model_config": config, "model": weights}, folder / "model.pt")


def _make_head(size):
    return _make_stack(WIDTHS, [None, None, None, None, size], [0, 1, 1, 1, 0])


def _make_stack(dim_in, dim_out, blocks):
    return {
        "dim_in": dim_in,
        "dim_out": dim_out,
        "dim_res_blocks": WIDTHS,
        "num_res_blocks": blocks,
        "res_block_in_norm": "none",
        "res_block_hidden_norm": "none",
        "resamplers": ["conv_transpose", "conv_transpose", "conv_transpose", "bilinear"],
    }
