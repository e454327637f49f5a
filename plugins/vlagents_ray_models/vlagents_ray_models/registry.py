"""The registry entries of this distribution, one for each policy."""

from vlagents_ray.registry import RegistryEntry

LEROBOT = RegistryEntry(
    "vlagents_ray_models.lerobot:LeRobot",
    "ACT, Diffusion, multi-task DiT, SmolVLA, X-VLA, GR00T N1.7, VQ-BeT, TD-MPC, π0, π0.5 and "
    "others of LeRobot 0.4 and 0.6",
    needs=("lerobot", "torch", "transformers"),
    requirements=("lerobot", "lerobot06"),
)

GR00T = RegistryEntry(
    "vlagents_ray_models.gr00t:Gr00t",
    "GR00T N1.6 and N1.7 by NVIDIA",
    needs=("gr00t", "transformers", "torch", "diffusers"),
    requirements=("gr00t", "gr00t_n1d7", "lerobot06"),
    checkouts=("GR00T_SRC",),
    deployment="isaac_gr00t",
)

PI0 = RegistryEntry(
    "vlagents_ray_models.pi0:Pi0",
    "π0 in Hugging Face transformers",
    needs=("transformers", "torch"),
    requirements=("hf",),
)

OPENPI = RegistryEntry(
    "vlagents_ray_models.openpi:OpenPi",
    "π0, π0.5, π0-FAST by Physical Intelligence, JAX and PyTorch",
    needs=("openpi", "jax", "flax", "transformers", "torch"),
    requirements=("openpi",),
    checkouts=("OPENPI_SRC",),
    deployment="pi05",
    page="pi0#openpi",
)

OPENVLA = RegistryEntry(
    "vlagents_ray_models.openvla.policy:OpenVLA",
    "OpenVLA",
    needs=("prismatic", "transformers", "torch", "timm"),
    requirements=("openvla",),
    checkouts=("OPENVLA_SRC", "OPENVLA_OFT_SRC"),
)

OPENVLA_OFT = RegistryEntry(
    "vlagents_ray_models.openvla.oft:OpenVLAOFT",
    "OpenVLA-OFT",
    needs=("prismatic", "transformers", "torch", "timm"),
    requirements=("openvla",),
    checkouts=("OPENVLA_OFT_SRC", "OPENVLA_SRC"),
    page="openvla",
)

OCTO = RegistryEntry(
    "vlagents_ray_models.octo:Octo",
    "Octo small and base 1.5, language or goal image",
    needs=("octo", "jax", "flax", "transformers"),
    requirements=("octo",),
    checkouts=("OCTO_SRC",),
)

DIFFUSION_POLICY = RegistryEntry(
    "vlagents_ray_models.diffusion_policy:DiffusionPolicy",
    "Stanford's Diffusion Policy, trusted files only",
    needs=("diffusion_policy", "torch", "diffusers", "dill", "omegaconf"),
    requirements=("diffusion_policy",),
    checkouts=("DIFFUSION_POLICY_SRC",),
)

VJEPA2_AC = RegistryEntry(
    "vlagents_ray_models.vjepa2_ac:VJepa2Ac",
    "V-JEPA 2-AC, planning to a goal image",
    needs=("src", "transformers", "torch", "timm"),
    requirements=("hf",),
    checkouts=("VJEPA2_SRC",),
)

ONNX = RegistryEntry(
    "vlagents_ray_models.onnx:Onnx",
    "any exported policy, an ONNX file or a TorchScript archive; recurrent ones too",
    needs=("onnxruntime",),
    extra="onnx",
    wants="`'plugins/vlagents_ray_models[onnx]'`",
)
