from tests.synth.conftest import bank, bank_folder, people_folder

__all__ = ["bank", "bank_folder", "people_folder"]
