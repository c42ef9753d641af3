"""Examples of each command, one or two, for its help and its man page."""

_LINES = """
facerf demo
facerf relight me.jpg --light 40,20 -o relit.png
facerf relight photos/ --envmap skies/ --rotate 0:360:24 -o relit/
facerf view me.jpg -o me.html
facerf view stacks/me_olat.exr -o me.html
facerf estimate-light me.jpg -o light.exr
facerf estimate-light shot.mp4 -o light/
facerf predict-olat me.jpg -o stacks/
facerf predict-olat me.jpg --lights '40,20;-40,20' --frame uv -o stacks/
facerf segment me.jpg -o cut.png
facerf segment group.jpg --face all -o cut/
facerf fit-geometry me.jpg -o me.glb
facerf fit-geometry photos/ --landmarks points/ -o fit/
facerf envmap --count 20 -o maps/
facerf envmap --kind sun --seed 3 -o maps/
facerf synth-stage --subjects 40 --lights 64 --jobs 2 -o capture/
facerf prepare-dataset capture/ --describe
facerf prepare-dataset capture/ --split 0.8/0.1/0.1 --jobs 2 -o dataset/
facerf relight-dataset dataset/ --envmaps skies/
facerf relight-dataset dataset/ --envmaps procedural:500 --per-subject 1000 --lazy
facerf train --dataset dataset/ -o run/ --max-time 2h
facerf train -o run/ --resume
facerf doctor
facerf doctor --checkpoint run/
facerf evaluate olat dataset/ -o report/
facerf evaluate olat dataset/ --against other.safetensors -o report/
facerf evaluate reconstruction photos/ -o report/
facerf evaluate reconstruction photos/ --reflectance prt -o report/
facerf evaluate transfer photos/ -o report/
facerf evaluate transfer dataset/ --reflectance field --reflectance prt -o report/
facerf evaluate geometry photos/ -o report/
facerf evaluate geometry photos/ --face-model ict.npz -o report/
facerf evaluate yale-b CroppedYale/ -o report/
facerf evaluate yale-b CroppedYale/ --checkpoint run/ --reflectance field -o report/
facerf evaluate cases dataset/ -o cases/
facerf evaluate cases dataset/ --split all --every 10 --same-pose -o cases/
facerf evaluate compare cases/ --reflectance field --method theirs=renders/ -o report/
facerf evaluate compare truth/ --method mine/ --method theirs/ --masks masks/ -o report/
facerf face-model import ICT-FaceKit.zip -o ict.npz
facerf face-model import flame.pkl --landmarks embedding.npy -o flame.npz
"""


def examples_of(command: str) -> list[str]:
    """Return the examples of a command, such as `evaluate olat`."""
    return [line for line in _LINES.splitlines() if f"{line} ".startswith(f"facerf {command} ")]


def epilog_of(command: str, notes: str) -> str:
    """Return the end of a command's help: notes, and its examples, whose lines stay apart."""
    return "\n".join([notes, "", "\b", "EXAMPLES", *(f"  {line}" for line in examples_of(command))])
