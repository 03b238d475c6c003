import torch

from lidarlearn.registration.association.point_buffer import PointBuffer


def test_buffer_keeps_order_of_last_scans_when_full():
    generator = torch.Generator().manual_seed(0)
    buffer, scans = PointBuffer(torch.device("cpu")), []
    for length in torch.randint(0, 30_000, (40,), generator=generator).tolist():
        points = torch.randn(3, length, generator=generator)
        buffer.forget(4)
        buffer.append(points, -points.mT)
        scans = [*scans, points][-5:]
        assert len(buffer) == len(scans)
        assert torch.equal(buffer.coordinates, torch.cat(scans, dim=1))
        assert torch.equal(buffer.normals, -torch.cat(scans, dim=1).mT)
        expected = [i for i, scan in enumerate(scans) for _ in range(scan.shape[1])]
        assert buffer.scans.tolist() == expected


def test_window_can_shrink():
    buffer = PointBuffer(torch.device("cpu"))
    for scans in (3, 3, 3, 1):
        buffer.forget(scans - 1)
        buffer.append(torch.ones(3, 4) * scans, torch.zeros(4, 3))
    assert len(buffer) == 1 and torch.equal(buffer.coordinates, torch.ones(3, 4))
    assert buffer.scans.tolist() == [0] * 4
