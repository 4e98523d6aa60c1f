"""Catalogue of the objects of GraspNet-1Billion: numbers, ids, names and masses."""

from __future__ import annotations

from dataclasses import dataclass

COUNT = 88  # objects in the dataset, numbered from 0


@dataclass(frozen=True)
class CatalogueEntry:
    """An object of GraspNet-1Billion.

    Attributes:
        number: number of the object in the dataset.
        id: id in a pack; the stand-in in the builtin pack has the same id.
        name: name in instructions.
        category: category of the object.
        mass: mass in kg; None: estimated from the volume.
        hollow: whether the object is a container or thin. If so, the hulls are checked by surface distance, not by IoU.
    """

    number: int
    id: str
    name: str
    category: str
    mass: float | None = None
    hollow: bool = False

    @property
    def folder_name(self) -> str:
        """Name of the object's folder, and prefix of its label file: the number with three digits."""
        return f"{self.number:03d}"


def _entry(
    number: int, id: str, category: str, mass: float, name: str = "", *, hollow: bool = False
) -> tuple[int, CatalogueEntry]:
    return number, CatalogueEntry(number, id, name or id.replace("_", " "), category, mass, hollow)


# objects of RoboCAS-v0. Masses of 1 to 32 and 71 are those of the YCB objects (plastic fruit; airplane kits of 0.57 kg,
# split among the parts); other masses are those of full products.
ENTRIES: dict[int, CatalogueEntry] = dict(
    [
        _entry(1, "sugar_box", "box", 0.514),
        _entry(2, "tomato_soup_can", "can", 0.349),
        _entry(3, "mustard_bottle", "bottle", 0.603),
        _entry(4, "potted_meat_can", "can", 0.370),
        _entry(5, "banana", "fruit", 0.066),
        _entry(7, "mug", "mug", 0.118, hollow=True),
        _entry(8, "power_drill", "tool", 0.895),
        _entry(9, "scissors", "tool", 0.082, hollow=True),
        _entry(10, "chips_can", "can", 0.205),
        _entry(12, "apple", "fruit", 0.068),
        _entry(13, "lemon", "fruit", 0.029),
        _entry(14, "peach", "fruit", 0.033),
        _entry(15, "pear", "fruit", 0.049),
        _entry(16, "orange", "fruit", 0.047),
        _entry(17, "plum", "fruit", 0.025),
        _entry(20, "flat_screwdriver", "tool", 0.098, "screwdriver"),
        _entry(21, "racquetball", "ball", 0.041, "rubber ball"),
        _entry(24, "toy_airplane_a", "toy", 0.095, "toy airplane", hollow=True),
        _entry(25, "toy_airplane_c", "toy", 0.085, "toy airplane", hollow=True),
        _entry(31, "toy_airplane_k", "toy", 0.080, "toy airplane", hollow=True),
        _entry(32, "padlock", "lock", 0.304),
        _entry(34, "secret_repair", "tube", 0.060, "repair cream"),
        _entry(35, "cleansing_foam", "bottle", 0.130),
        _entry(36, "washing_soap", "bottle", 0.300),
        _entry(37, "mouth_rinse", "bottle", 0.330),
        _entry(38, "sod_lotion", "bottle", 0.120, "lotion"),
        _entry(39, "soap_box", "box", 0.115),
        _entry(40, "cleanser", "bottle", 0.240),
        _entry(41, "toothpaste", "tube", 0.135),
        _entry(42, "face_oil_control", "tube", 0.120, "oil control face wash"),
        _entry(44, "jam_jar", "jar", 0.320),
        _entry(47, "white_mouse", "mouse", 0.090, "white computer mouse"),
        _entry(51, "large_elephant", "toy", 0.140, "large toy elephant"),
        _entry(52, "rhinoceros", "toy", 0.095, "toy rhinoceros"),
        _entry(53, "small_elephant", "toy", 0.050, "small toy elephant"),
        _entry(54, "monkey", "toy", 0.065, "toy monkey"),
        _entry(57, "drink", "bottle", 0.480, "drink bottle"),
        _entry(58, "toothpaste_box", "box", 0.150),
        _entry(59, "soap", "soap", 0.100),
        _entry(61, "face_wash", "tube", 0.125),
        _entry(62, "shampoo_white", "bottle", 0.390, "white shampoo"),
        _entry(63, "shampoo_supreme", "bottle", 0.390, "supreme shampoo"),
        _entry(64, "mouthwash", "bottle", 0.330),
        _entry(65, "shower_cream", "bottle", 0.390),
        _entry(66, "shampoo_care", "bottle", 0.390, "care shampoo"),
        _entry(71, "rubiks_cube", "toy", 0.094, "puzzle cube"),
    ]
)

NUMBERS: dict[str, int] = {entry.id: number for number, entry in ENTRIES.items()}


def find_catalogue_entry(number: int) -> CatalogueEntry:
    """Return the entry of the object with a number.

    Objects that RoboCAS-v0 does not use have generic names.

    Raises:
        ValueError: the number is not between 0 and 87.
    """
    if not 0 <= number < COUNT:
        raise ValueError(f"invalid number {number} of a GraspNet-1Billion object: expected 0 to {COUNT - 1}")
    return ENTRIES.get(number) or CatalogueEntry(number, f"graspnet_{number:03d}", f"object {number}", "object")
