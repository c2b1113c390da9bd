"""Calibrations in OCamCalib's and NavVis' layouts, for tests."""

import numpy as np

from wearcap.io.formats.ocamcalib import OCamModel


def lens(scale: float = 1.0) -> OCamModel:
    """A lens like those on NavVis' trolleys; its inverse polynomial is fitted here as OCamCalib fits it."""
    pol = np.array([-1983.0, 0.0, 2.17e-4, -4.0e-8, 1.62e-11]) * scale / scale ** np.arange(5)
    rho = np.linspace(0, 2900 * scale, 500)
    angle = np.arctan(np.polynomial.polynomial.polyval(rho, pol) / np.maximum(rho, 1e-9))
    invpol = np.polynomial.polynomial.polyfit(angle, rho, 14)
    width, height = round(4592 * scale), round(3448 * scale)
    return OCamModel(
        tuple(pol.tolist()),
        tuple(invpol.tolist()),
        1745.64 * scale,
        2289.58 * scale,
        (1.0005, -0.0014, 0.0015),
        width,
        height,
    )


def xml_of(models: dict[str, OCamModel]) -> str:
    def coefficients(values) -> str:
        return "".join(f"<coeff>{value!r}</coeff>" for value in values)

    cameras = "".join(
        f"<CameraModel><SensorName>{name}</SensorName><Pose><position><x>0</x></position></Pose>"
        f"<ImageSize><Width>{m.width}</Width><Height>{m.height}</Height></ImageSize>"
        f"<OCamModel><c>{m.affine[0]}</c><d>{m.affine[1]}</d><e>{m.affine[2]}</e><cx>{m.row}</cx><cy>{m.column}</cy>"
        f"<cam2world>{coefficients(m.pol)}</cam2world><world2cam>{coefficients(m.invpol)}</world2cam></OCamModel></CameraModel>"
        for name, m in models.items()
    )
    return (
        '<?xml version="1.0" ?><SensorFrame><Hardware><Model>M6</Model></Hardware><CameraHead>'
        f"<SensorName>cam_head</SensorName>{cameras}</CameraHead><LaserModel/></SensorFrame>"
    )
