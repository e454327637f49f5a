"""The entries that this distribution registers: one for each dialect, and the policy `upstream`."""

from vlagents_ray.registry import RegistryEntry

OPENPI = RegistryEntry("vlagents_ray_dialects.openpi:OpenPiDialect")
ROBOARENA = RegistryEntry("vlagents_ray_dialects.openpi:RoboArenaDialect")
OPENVLA = RegistryEntry("vlagents_ray_dialects.openvla:OpenVLADialect")
VLA_EVAL = RegistryEntry("vlagents_ray_dialects.vla_eval:VlaEvalDialect")
GR00T = RegistryEntry("vlagents_ray_dialects.gr00t:GR00TDialect")
XPOLICYLAB = RegistryEntry("vlagents_ray_dialects.xpolicylab:XPolicyLabDialect")
SGLANG = RegistryEntry("vlagents_ray_dialects.sglang:SGLangDialect")
VLAGENTS = RegistryEntry("vlagents_ray_dialects.vlagents:VlagentsDialect")
LEROBOT = RegistryEntry("vlagents_ray_dialects.lerobot:LeRobotDialect")
LEROBOT_REMOTE = RegistryEntry("vlagents_ray_dialects.lerobot_remote:LeRobotRemoteDialect")

UPSTREAM = RegistryEntry(
    "vlagents_ray_dialects.upstream:Upstream",
    "any model behind openpi, RoboArena, GR00T, OpenVLA, vla-eval, vlagents, SGLang, vLLM-Omni or "
    "FlashRT",
    wants="that server",
)
