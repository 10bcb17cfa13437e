"""Open3D in a process of its own: without a graphics driver it ends the process it runs in.

`python -m maexp.envs.render.open3d_worker FACES.npz PICTURE.png` draws off-screen; without PICTURE it opens a
window and returns when that is closed. `show.py` writes FACES.npz and starts it.
"""

import sys

import numpy as np


def main(faces: str, picture: str | None = None) -> int:
    """Draw the faces; 1 where that did not work."""
    import open3d as o3d

    with np.load(faces, allow_pickle=False) as arrays:
        data = {name: arrays[name] for name in arrays.files}
    mesh = make_mesh(o3d, data["corners"], data["colour"])
    return draw_picture(o3d, mesh, data, picture) if picture else open_window(o3d, mesh, data)


def make_mesh(o3d, corners: np.ndarray, colour: np.ndarray):
    """Two triangles per quadrilateral [Q, 4, 3], coloured uint8 [Q, 3]."""
    first = 4 * np.arange(len(corners))[:, None]
    triangles = np.concatenate([first + [0, 1, 2], first + [0, 2, 3]]).astype(np.int32)
    mesh = o3d.geometry.TriangleMesh()
    mesh.vertices = o3d.utility.Vector3dVector(corners.reshape(-1, 3).astype(np.float64))
    mesh.triangles = o3d.utility.Vector3iVector(triangles)
    mesh.vertex_colors = o3d.utility.Vector3dVector(np.repeat(colour / 255.0, 4, axis=0))
    return mesh


def draw_picture(o3d, mesh, data: dict, path: str) -> int:
    """The picture as PNG, unlit: the colours are shaded already."""
    width, height = data["size"].tolist()
    rendering = o3d.visualization.rendering
    renderer = rendering.OffscreenRenderer(2 * width, 2 * height)
    material = rendering.MaterialRecord()
    material.shader = "defaultUnlit"
    renderer.scene.set_background([1.0, 1.0, 1.0, 1.0])
    renderer.scene.view.set_post_processing(False)  # tone mapping would change the colours
    renderer.scene.add_geometry("scene", mesh, material)
    renderer.setup_camera(float(data["fov"]), *data["target_eye_up"].astype(np.float32))
    image = np.asarray(renderer.render_to_image())
    if image.std() < 1:
        print("Open3D drew an empty picture", file=sys.stderr)
        return 1
    from PIL import Image

    Image.fromarray(image).reduce(2).save(path, "PNG")
    return 0


def open_window(o3d, mesh, data: dict) -> int:
    """A window to turn and zoom in; returns when it is closed."""
    width, height = data["size"].tolist()
    window = o3d.visualization.Visualizer()
    if not window.create_window(str(data["title"]), width, height):
        print("Open3D could open no window", file=sys.stderr)
        return 1
    window.add_geometry(mesh)
    window.get_render_option().light_on = False
    window.get_render_option().mesh_show_back_face = True
    control = window.get_view_control()
    target, eye, up = data["target_eye_up"]
    control.set_lookat(target)
    control.set_front(eye - target)
    control.set_up(up)
    control.set_zoom(0.7)
    window.run()
    window.destroy_window()
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
