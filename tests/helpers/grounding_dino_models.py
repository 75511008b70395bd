"""Grounding DINO, tiny and with random weights, as a folder that the real loading code reads."""

WORDS = ("table", "person", "hand", "arm", "cup", "mug", "wine", "glass", "bottle", "bowl", "spoon", "box", "toy")
# The model knows these tokens by their numbers in BERT's vocabulary
SPECIAL = {"[PAD]": 0, "[UNK]": 100, "[CLS]": 101, "[SEP]": 102, "[MASK]": 103, ".": 1012, "?": 1029}


def save_tiny_dino(folder, seed=0, max_text_len=256, words=WORDS):
    """The true architecture with its tokenizer, saved as its authors' are; its boxes and scores are well apart."""
    import torch
    import transformers

    config = transformers.GroundingDinoConfig(
        backbone_config=transformers.SwinConfig(
            embed_dim=8, depths=[1, 1, 1, 1], num_heads=[1, 1, 2, 2], window_size=4, out_indices=[2, 3, 4],
        ),
        text_config=transformers.BertConfig(
            vocab_size=1100, hidden_size=16, num_hidden_layers=1, num_attention_heads=2, intermediate_size=16,
        ),
        d_model=32, encoder_layers=1, decoder_layers=2, encoder_ffn_dim=16, decoder_ffn_dim=16,
        encoder_attention_heads=2, decoder_attention_heads=2, num_queries=30, max_text_len=max_text_len,
    )  # fmt: skip
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = transformers.GroundingDinoForObjectDetection(config).eval()
        with torch.no_grad():
            for name, weight in model.named_parameters():
                if "bbox_embed" in name or "text_projection" in name:
                    weight.mul_(8.0)
    model.save_pretrained(folder)
    save_tokenizer(folder, words)
    return model


def save_tokenizer(folder, words=WORDS):
    """BERT's tokenizer with a few words."""
    import tokenizers
    import transformers

    vocabulary = {**SPECIAL, **{word: 1030 + k for k, word in enumerate(words)}}
    vocabulary |= {f"[unused{k}]": k for k in range(1100) if k not in vocabulary.values()}
    made = tokenizers.Tokenizer(tokenizers.models.WordPiece(vocabulary, unk_token="[UNK]"))  # noqa: S106
    made.normalizer = tokenizers.normalizers.BertNormalizer(lowercase=True)
    made.pre_tokenizer = tokenizers.pre_tokenizers.BertPreTokenizer()
    made.post_processor = tokenizers.processors.TemplateProcessing(
        single="[CLS] $A [SEP]", special_tokens=[("[CLS]", 101), ("[SEP]", 102)]
    )
    names = {f"{name}_token": f"[{name.upper()}]" for name in ("unk", "pad", "cls", "sep")}
    transformers.BertTokenizerFast(tokenizer_object=made, **names).save_pretrained(folder)
