"""VGG-16 of torchvision, downloaded once or read from a file: the paper's image features V_f."""

from pathlib import Path

from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.downloads import PublishedFile, fetch
from facerf_cli.network.checkpoint import read_tensors
from facerf_cli.network.features import VggFeatures

# torchvision's IMAGENET1K_V1; its file name contains the first eight digits of the digest.
VGG16 = PublishedFile(
    "https://download.pytorch.org/models/vgg16-397923af.pth",
    sha256="397923af8e79cdbb6a7127f12361acd7a2f83e06b05044ddf496e83de57a5bf0",
    size_limit=600 * 2**20,  # the file has 553433881 bytes
)
VGG16_LICENCE = (
    "VGG-16: torchvision (BSD-3-Clause), trained on ImageNet (pictures for non-commercial research)"
)
_VGG_ADVICE = "use --vgg-weights imagenet, or a .pth or .safetensors of torchvision's vgg16-397923af"


def load_vgg(choice: str | Path | None, network: VggFeatures | None = None) -> VggFeatures:
    """Load V_f, frozen, for a value of `--vgg-weights`: 'imagenet', or a .pth or .safetensors of VGG-16.

    'imagenet' is downloaded once and verified; a file must have torchvision's names. Pickles are read with
    `weights_only`. `network` receives the weights instead of a new V_f. Raises UsageError for None.
    """
    if choice is None:
        raise UsageError(
            "--vgg-weights: missing, but the feature loss needs VGG-16; use --vgg-weights imagenet "
            "(downloads 528 MiB once), or --vgg-weights PATH of torchvision's vgg16-397923af.pth; training "
            "also takes --appearance-features FILE"
        )
    path = fetch(VGG16, "--vgg-weights PATH") if str(choice) == "imagenet" else Path(choice)
    network = VggFeatures() if network is None else network
    try:
        network.load_published(read_tensors(path, _VGG_ADVICE))
    except ValueError as error:
        raise InputError(f"{path}: not VGG-16 with torchvision's names ({error}); {_VGG_ADVICE}") from None
    network.eval().requires_grad_(False)
    return network
