import torch

from lidarlearn.registration.association.point_buffer import PointBuffer


def test_the_last_scans_stand_behind_each_other_however_often_the_buffers_are_full():
    generator = torch.Generator().manual_seed(0)
    window, scans = PointBuffer(torch.device("cpu")), []
    for length in torch.randint(0, 30_000, (40,), generator=generator).tolist():
        points = torch.randn(3, length, generator=generator)
        window.forget(4)
        window.push(points, -points.mT)
        scans = [*scans, points][-5:]
        assert len(window) == len(scans)
        assert torch.equal(window.coordinates, torch.cat(scans, dim=1))
        assert torch.equal(window.normals, -torch.cat(scans, dim=1).mT)
        expected = [i for i, scan in enumerate(scans) for _ in range(scan.shape[1])]
        assert window.scans.tolist() == expected


def test_fewer_scans_can_be_kept_later_on():
    window = PointBuffer(torch.device("cpu"))
    for scans in (3, 3, 3, 1):
        window.forget(scans - 1)
        window.push(torch.ones(3, 4) * scans, torch.zeros(4, 3))
    assert len(window) == 1 and torch.equal(window.coordinates, torch.ones(3, 4))
    assert window.scans.tolist() == [0] * 4
